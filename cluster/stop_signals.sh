# shellcheck shell=bash
# Shared by slurm.sbatch and start_or_resume.sh. Both begin with
#   asked=0
#   trap 'asked=1' USR1 TERM INT HUP
# so that from their first line on a stop signal is remembered instead of ending them.

resumable=75 # exit code of a program that was asked to stop, saved its state, and can be resumed

# shellcheck disable=SC2154 # they set `asked`
# Wait for a child and pass a request to stop on to it. Its exit code is left in `code`.
#
# It polls, because `wait` can miss a signal that arrives just before it. The request is passed on as USR1, which no
# library intercepts, and repeated, because a child that is still a copy of this shell loses it.
await() {
    local turn=0
    while kill -0 "$1" 2>/dev/null; do
        if ((asked && turn++ % 10 == 0)); then
            kill -s USR1 "$1" 2>/dev/null || true # it may just have ended by itself
        fi
        sleep 0.5 || true # a signal to the whole process group ends it
    done
    code=0
    wait "$1" || code=$?
    # Killed by the request: it did not handle signals yet, or no longer. Nothing is left to save.
    if ((asked && (code == 129 || code == 138 || code == 143))); then # 128 + HUP, USR1, TERM
        code=$resumable
    fi
}
