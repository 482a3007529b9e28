#!/usr/bin/env bash
# Start a space's experiment, or go on with it if it began before: what a scheduler that restarts jobs has to run.
#
#   cluster/start_or_resume.sh SPACE STORAGE [options of python -m msk_ray.tune]
set -euo pipefail

if (($# < 2)); then
    echo "usage: start_or_resume.sh SPACE STORAGE [options of python -m msk_ray.tune]" >&2
    exit 2
fi
space=$1
storage=$2
shift 2
name=$(basename "$space" .yaml)

resume=()
if [[ -e $storage/$name/manifest.json ]]; then
    resume=(--resume)
fi
# exec: signals reach the driver itself, and its exit code is this script's.
exec "${MSK_RAY_PYTHON:-python}" -m msk_ray.tune \
    --space "$space" --name "$name" --storage "$storage" "${resume[@]}" "$@"
