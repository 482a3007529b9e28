#!/usr/bin/env bash
# Ray on one node: the job step that slurm.sbatch runs on each of its nodes, with the cluster's token on standard input.
#
#   slurm_node.sh FOLDER ray start --block ...
#
# FOLDER, on the node's own disk, is created for this user only and holds Ray's sockets and logs and the token.

# They ask the driver to stop, which needs Ray until all trials have saved. Whatever Ray starts ignores them too.
trap '' USR1 HUP INT
ray=
ended=0
trap 'ended=1; [[ -z $ray ]] || kill "$ray" 2>/dev/null || true' TERM USR2 # USR2: srun kills a step instead of passing TERM on
set -euo pipefail
umask 077
folder=$1
shift

# A folder is locked as long as its step runs. What killed jobs have left here is removed now, tokens included.
for left in "${folder%/*}"/msk_ray-*; do
    if [[ -d $left && ! -L $left && -O $left ]]; then
        # shellcheck disable=SC2094 # a lock is neither read nor written
        # The other way out: another job that starts here was faster.
        (if flock --nonblock 8; then rm -rf -- "$left"; fi) 8<"$left" || [[ ! -e $left ]]
    fi
done
# Under another name until it is locked, so that no other job takes it for a leftover. mkdir fails if it exists.
mkdir -m 700 -- "${folder%/*}/new-${folder##*/}"
exec 9<"${folder%/*}/new-${folder##*/}"
flock --nonblock 9
mv -T -- "${folder%/*}/new-${folder##*/}" "$folder"
cat >"$folder/token.new"
mv -- "$folder/token.new" "$folder/token"

# In braces, which bash reads as a whole, so that editing this file does not affect a running node.
{
    code=0
    if ((!ended)); then
        # SLURM signals all processes of a step; this one alone ends Ray at USR2, in order.
        (
            trap '' USR2
            exec "$@" </dev/null
        ) &
        ray=$!
        while kill -0 "$ray" 2>/dev/null; do
            # Again: the first may have come before there was anything to end.
            ((!ended)) || kill "$ray" 2>/dev/null || true
            { sleep 0.5 || true; } 2>/dev/null # bash says so when the signal ends it too
        done
        wait "$ray" || code=$?
    fi
    rm -f -- "$folder/token"
    if ((ended)); then
        exit 0
    fi
    exit "$code"
}
