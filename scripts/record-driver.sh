#!/usr/bin/env bash
# Checks a small training step on the device in use, prints how many of its passes are identical to their references,
# within their rounding, or wrong, and records that in docs/drivers.csv, a line for each driver. Arguments run a program
# elsewhere, as in a chroot:
#     scripts/record-driver.sh [COMMAND..]
set -euo pipefail
cd "$(dirname "$0")/.."
nightsplat=${NIGHTSPLAT:-${CARGO_TARGET_DIR:-target}/debug/nightsplat}
status=0
found=$("$@" "$nightsplat" bench --json --repeats 1 --gaussians 500 --width 128 --height 96) || status=$?
value() { sed -n "s/^  \"$1\": \"\(.*\)\",\{0,1\}$/\1/p" <<< "$found"; }
driver="\"$(value device)\",\"$(value driver)\""
passes=$(value passes)
if [ -z "$passes" ]; then
    echo "failed: the bench does not run on $driver"
    exit 1
fi
echo "$driver: $passes"
list=docs/drivers.csv
{
    echo 'device,driver,identical passes,passes within rounding,failed passes'
    {
        [ ! -e "$list" ] || tail -n +2 "$list" | grep -vF "$driver," || true
        echo "$driver,$(grep -o '[0-9]* \(identical\|within\|failed\)' <<< "$passes" | cut -d ' ' -f 1 | paste -sd ,)"
    } | LC_ALL=C sort
} > "$list.new"
mv "$list.new" "$list"
exit "$status"
