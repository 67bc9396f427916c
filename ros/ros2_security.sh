# Where two packages have the command `ros2 security`, ros2cli takes the one that Python finds last.
# A workspace comes before /opt/ros in PYTHONPATH, so the command of sros2 there would be taken:
# this names the command of sros again, at the end.
sros_path="$COLCON_CURRENT_PREFIX/share/sros_tool/ros2_security"
case ":${PYTHONPATH-}:" in
    *":$sros_path:"*) ;;
    *) export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}$sros_path" ;;
esac
unset sros_path
