#!/usr/bin/env bash
# Says that something is not run, for lack of what, and why; fails if NIGHTSPLAT_REQUIRE, a list separated by commas,
# names one of those:
#     scripts/not-run.sh chromium,ffmpeg 'the page in a browser: there is no chromium'
set -euo pipefail
echo "not run: $1: $2"
for need in ${1//,/ }; do
    if [[ ",${NIGHTSPLAT_REQUIRE:-}," == *",$need,"* ]]; then
        echo "failed: NIGHTSPLAT_REQUIRE names $need"
        exit 1
    fi
done
