#!/usr/bin/env bash
# Runs the tests, of which exactly those must fail that a file names, with the reason behind `#`. What follows goes to
# `cargo test`:
#     scripts/test-with-known-failures.sh scripts/known-failures/swiftshader.txt --test splats
# A failure that is not named, a named one that passes and a process that died are failures of this script.
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

# Each test that ran with what became of it, be it the test's own word or the validation layer's at the end of the process.
outcomes() {
    sed -n 's/^test \(.*\) \.\.\. \(ok\|FAILED\)$/\2 \1/p' "$log"
    sed -n '/^validation failed in$/,/^ *Running /s/^\([a-z0-9_:]*\): .*/FAILED \1/p' "$log"
}
failed=$(outcomes | sed -n 's/^FAILED //p' | sort -u)
named=$(sed 's/ *#.*//; /^skip /d; /^$/d' "$list" | sort -u)
ran=$(outcomes | cut -d ' ' -f 2- | sort -u)
unnamed=$(comm -23 <(echo "$failed") <(echo "$named"))
mended=$(comm -12 <(comm -13 <(echo "$failed") <(echo "$named")) <(echo "$ran"))
# A process that died leaves tests without an outcome.
died=$(grep -E 'process didn.t exit successfully.*signal' "$log")

status=0
for problem in "fails and is not named:$unnamed" "is named and passes:$mended" "died:$died"; do
    if [ -n "${problem#*:}" ]; then
        echo "${problem%%:*}:" && echo "${problem#*:}" && status=1
    fi
done
if [ "$status" -eq 0 ]; then
    echo "$(wc -w <<< "$ran") tests ran; those that fail are the $(grep -c . <<< "$failed") that are named"
fi
exit "$status"
