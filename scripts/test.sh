#!/usr/bin/env bash
# Runs `cargo test` with the given arguments, then prints the seconds of each test program and of the ten slowest tests,
# and last what failed: a failing program does not keep the others from running.
#
# Not cargo-nextest, which prints the same: newcomers would have to install it, and a process for each test, with a
# Vulkan device and kernels of its own, takes longer than one for all tests of a program.
set -euo pipefail

# As cargo's runner of the programs that it has built.
if [ -n "${NIGHTSPLAT_TIMES:-}" ]; then
    began=$EPOCHREALTIME
    status=0
    # The compiler's own times are not stable; this lets them be printed.
    RUSTC_BOOTSTRAP=1 "$@" -Z unstable-options --report-time | tee -a "$NIGHTSPLAT_TIMES/tests" || status=$?
    name=$(basename "$1")
    awk -v name="${name%-*}" -v began="$began" -v ended="$EPOCHREALTIME" \
        'BEGIN { printf "%8.1f s  %s\n", ended - began, name }' >> "$NIGHTSPLAT_TIMES/programs"
    [ "$status" = 0 ] || echo "${name%-*} ended with exit code $status" >> "$NIGHTSPLAT_TIMES/failed"
    exit "$status"
fi

NIGHTSPLAT_TIMES=$(mktemp -d)
export NIGHTSPLAT_TIMES
trap 'rm -rf "$NIGHTSPLAT_TIMES"' EXIT
touch "$NIGHTSPLAT_TIMES"/{tests,programs,failed}
status=0
timed() { cargo test --no-fail-fast --config "target.'cfg(all())'.runner = ['$(realpath "$0")']" "$@"; }
if [ $# -gt 0 ]; then
    timed "$@" || status=$?
else
    # What cargo runs by default; examples of the documentation have no runner.
    timed --workspace --lib --bins --tests --examples || status=$?
    cargo test --workspace --doc --no-fail-fast || { status=$? && echo "documentation" >> "$NIGHTSPLAT_TIMES/failed"; }
fi
echo "test programs, slowest first:"
sort -rn "$NIGHTSPLAT_TIMES/programs"
echo "the slowest tests:"
sed -n 's/^test \(.*\) \.\.\. .*<\([0-9.]*\)s>$/\2 \1/p' "$NIGHTSPLAT_TIMES/tests" | sort -rn |
    awk 'NR <= 10 { printf "%8.1f s  %s\n", $1, $2 }'
if [ "$status" != 0 ]; then
    echo "failed:"
    sed -n 's/^test \(.*\) \.\.\. FAILED.*/    \1/p' "$NIGHTSPLAT_TIMES/tests"
    sed 's/^/    /' "$NIGHTSPLAT_TIMES/failed"
fi
exit "$status"
