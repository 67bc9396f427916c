# Where two packages have the command `ros2 security`, ros2cli takes the one that Python finds last.
# A workspace comes before /opt/ros in PYTHONPATH, so the command of sros2 there would be taken:
# this names the command of sros again, at the end.
sros_path="$COLCON_CURRENT_PREFIX/share/sros_tool/ros2_security"
case ":${PYTHONPATH-}:" in
    *":$sros_path:"*) ;;
    *)
        # colcon leaves a ":" at the end until later: in the middle it is the working folder.
        sros_before="${PYTHONPATH-}"
        sros_before="${sros_before%:}"
        export PYTHONPATH="${sros_before:+$sros_before:}$sros_path"
        unset sros_before
        ;;
esac
unset sros_path
