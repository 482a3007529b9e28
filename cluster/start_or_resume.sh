#!/usr/bin/env bash
# Start a space's experiment, or resume it if it exists: for schedulers that restart jobs.
#
#   cluster/start_or_resume.sh SPACE STORAGE [options of python -m msk_ray.tune]
#
# HUP, INT, TERM and USR1 mean: save everything and end with 75, even before there is anything to save.
asked=0
trap 'asked=1' USR1 TERM INT HUP
set -euo pipefail

if (($# < 2)); then
    echo "usage: start_or_resume.sh SPACE STORAGE [options of python -m msk_ray.tune]" >&2
    exit 2
fi
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/stop_signals.sh"

# In braces, which bash reads as a whole, so that editing this file does not affect a running driver.
{
    "${MSK_RAY_PYTHON:-python}" -m msk_ray.tune --space "$1" --storage "$2" --start-or-resume "${@:3}" &
    await "$!"
    exit "$code"
}
