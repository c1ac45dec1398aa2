#!/usr/bin/env bash
# Runs the tests and passes if exactly those fail that a file lists, each with its reason after `#`. Further arguments
# go to `cargo test`:
#     scripts/test-with-known-failures.sh scripts/known-failures/swiftshader.txt --test splats
# An unlisted failure, a listed test that passes, and a process that dies are failures.
set -uo pipefail
cd "$(dirname "$0")/.."
list=${1:?name the file of known failures}
shift

log=$(mktemp)
trap 'rm -f "$log"' EXIT
skipped=$(sed -n 's/^skip \([^ ]*\).*/--skip \1/p' "$list")
cargo test --no-fail-fast "$@" -- $skipped 2>&1 | tee "$log"
if ! grep -q '^test result' "$log"; then
    echo "failed: no test ran"
    exit 1
fi

# Each test with its result: its own, or that of the validation layer at the end of the process.
outcomes() {
    sed -n 's/^test \(.*\) \.\.\. \(ok\|FAILED\)$/\2 \1/p' "$log"
    sed -n '/^validation failed in$/,/^ *Running /s/^\([a-z0-9_:]*\): .*/FAILED \1/p' "$log"
}
failed=$(outcomes | sed -n 's/^FAILED //p' | sort -u)
named=$(sed 's/ *#.*//; /^skip /d; /^$/d' "$list" | sort -u)
ran=$(outcomes | cut -d ' ' -f 2- | sort -u)
unnamed=$(comm -23 <(echo "$failed") <(echo "$named"))
mended=$(comm -12 <(comm -13 <(echo "$failed") <(echo "$named")) <(echo "$ran"))
# A process that died leaves tests without a result.
died=$(grep -E 'process didn.t exit successfully.*signal' "$log")

status=0
for problem in "fails but is not listed:$unnamed" "is listed but passes:$mended" "died:$died"; do
    if [ -n "${problem#*:}" ]; then
        echo "${problem%%:*}:" && echo "${problem#*:}" && status=1
    fi
done
if [ "$status" -eq 0 ]; then
    echo "$(wc -w <<< "$ran") tests ran; exactly the $(grep -c . <<< "$failed") listed ones fail"
fi
exit "$status"
