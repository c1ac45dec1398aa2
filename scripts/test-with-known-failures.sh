#!/usr/bin/env bash
# Runs every test, and demands that exactly those fail that a file lists, one a line:
#     scripts/test-with-known-failures.sh scripts/known-failures/swiftshader.txt
set -euo pipefail
cd "$(dirname "$0")/.."
known=$(sed 's/ *#.*//' "${1:?name the file of known failures}" | grep . | sort -u || true)

log=$(mktemp)
trap 'rm -f "$log"' EXIT
cargo test --no-fail-fast 2>&1 | tee "$log" || true
ran=$(grep -c '^test result:' "$log") || { echo "no test was run"; exit 1; }
failed=$(sed -n 's/^test \(.*\) \.\.\. FAILED$/\1/p' "$log" | sort -u)

new=$(comm -13 <(echo "$known") <(echo "$failed") | grep . || true)
mended=$(comm -23 <(echo "$known") <(echo "$failed") | grep . || true)
[ -z "$new" ] || printf 'fails: %s\n' $new
[ -z "$mended" ] || printf 'known to fail, and passes: %s\n' $mended
# A binary that ended without a line of its own is no test that failed by name.
grep -q 'error: test failed\|error: [0-9]* targets\? failed' "$log" && [ -z "$failed" ] && new=crash
[ -z "$new$mended" ] && echo "$ran test binaries; what fails is known"
