#!/usr/bin/env bash
# Builds examples/window, and compares its pictures, on an X server without a screen, with the library's own renders.
set -euo pipefail
cd "$(dirname "$0")/../examples/window"

command -v xvfb-run > /dev/null ||
    exec ../../scripts/not-run.sh xvfb 'there is no xvfb-run (on Debian `apt install xvfb xauth`)'
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-../../target}
# Its lints check every crate below it once more: once a week.
[ -z "${NIGHTSPLAT_WEEKLY:-}" ] || cargo clippy --locked --all-targets -- -D warnings
cargo test --locked
