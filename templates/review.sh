# Review a policy: what the GitHub Action and the GitLab template of sros run.
#
# Writes Markdown to $SROS_SUMMARY and SARIF to $SROS_SARIF. The exit status is the worst of its
# commands: 0 if all is well, 1 if something is found, 2 if something could not be decided.
set -u
: >"$SROS_SUMMARY"
status=0
worst() {
    if [ "$1" -gt "$status" ]; then status=$1; fi
}

set -- "$SROS_POLICY"
if [ -n "$SROS_REQUIREMENTS" ]; then set -- "$@" --requirements "$SROS_REQUIREMENTS"; fi
sros check policy "$@" --format markdown >>"$SROS_SUMMARY" || worst $?
sros check policy "$@" --format sarif >"$SROS_SARIF" || worst $?

if [ -n "$SROS_BASE" ]; then
    git cat-file -e "$SROS_BASE^{commit}" 2>/dev/null ||
        git fetch --quiet --no-tags --depth=1 origin "$SROS_BASE"
    before=$(mktemp -d)
    if ! git -c core.hooksPath=/dev/null worktree add --quiet --detach "$before/tree" "$SROS_BASE"; then
        echo "the base $SROS_BASE is not there, so nothing can be compared with it" >&2
        worst 2
    elif [ ! -e "$before/tree/$SROS_POLICY" ]; then
        printf '### Rights: the policy is new, so all of its access is new\n' >>"$SROS_SUMMARY"
        if [ "$SROS_NEW_ACCESS" != allow ]; then worst 1; fi
    else
        earlier=$before/tree/$SROS_REQUIREMENTS
        if [ -n "$SROS_REQUIREMENTS" ] && [ -f "$earlier" ] &&
            ! cmp -s "$earlier" "$SROS_REQUIREMENTS"; then
            printf '### The requirements change: these are decided as they were before\n\n' \
                >>"$SROS_SUMMARY"
            sros check policy "$SROS_POLICY" --requirements "$earlier" --include 'requirement.*' \
                --format markdown >>"$SROS_SUMMARY" || {
                code=$?
                if [ "$code" -gt 1 ] || [ "$SROS_NEW_ACCESS" != allow ]; then worst "$code"; fi
            }
        fi
        sros diff_policy "$before/tree/$SROS_POLICY" "$SROS_POLICY" --format markdown \
            >>"$SROS_SUMMARY" || { code=$?; if [ "$code" -gt 1 ]; then worst "$code"; fi; }
        sros diff_policy --no-new-access "$before/tree/$SROS_POLICY" "$SROS_POLICY" \
            --format markdown >>"$SROS_SUMMARY" || {
            code=$?
            if [ "$code" -gt 1 ] || [ "$SROS_NEW_ACCESS" != allow ]; then worst "$code"; fi
        }
    fi
    rm -rf "$before"
    git worktree prune
fi

if [ -n "$SROS_KEYSTORE" ]; then
    sros check --needs-renewal "$SROS_RENEW_WITHIN" "$SROS_KEYSTORE" --format markdown \
        >>"$SROS_SUMMARY" || worst $?
fi
exit "$status"
