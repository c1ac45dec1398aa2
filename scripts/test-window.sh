#!/usr/bin/env bash
# Builds examples/window.rs and `view --window`, and compares their pictures, on an X server without a screen, with our
# own renders.
set -euo pipefail
cd "$(dirname "$0")/.."

cargo build --locked --features window --example window
cargo test --locked --features window --test window
