#!/usr/bin/env bash
# Builds examples/wgpu, and has wgpu's own device draw a model under the validation layer: without a message, and the
# library's own picture to a level. With the argument bevy, or once a week, Bevy's device as well (examples/bevy, whose
# 300 crates take minutes).
set -euo pipefail
cd "$(dirname "$0")/../examples/wgpu"
with_bevy=${NIGHTSPLAT_WEEKLY:-${1:-}}

export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/../../target}
# Its lints check every crate below it once more: once a week.
[ -z "${NIGHTSPLAT_WEEKLY:-}" ] || cargo clippy --locked --all-targets -- -D warnings
cargo build --locked
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# Some hundred Gaussians around the origin.
awk 'BEGIN {
    count = 300; srand(7)
    print "ply\nformat ascii 1.0\nelement vertex " count
    split("x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3", names, " ")
    for (k = 1; k <= 14; k++) print "property float " names[k]
    print "end_header"
    for (i = 0; i < count; i++) {
        for (k = 1; k <= 3; k++) printf "%.4f ", 2 * rand() - 1
        for (k = 4; k <= 6; k++) printf "%.4f ", 2 * rand() - 0.5
        printf "%.4f %.4f %.4f %.4f ", rand(), rand() - 3, rand() - 3, rand() - 3
        print 0.1 + rand(), 0.1 + rand(), 0.1 + rand(), 0.1 + rand()
    }
}' > "$folder/model.ply"
export VK_INSTANCE_LAYERS=VK_LAYER_KHRONOS_validation
export VK_LAYER_ENABLES=VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT
# draws NAME PROGRAM [ARGUMENT..]: the program draws the model.
draws() {
    local name=$1 program=$2 printed
    shift 2
    printed=$("$CARGO_TARGET_DIR/debug/$program" "$folder/model.ply" "$folder/out.ppm" "$@" 2>&1) ||
        { echo "$printed" >&2 && exit 1; }
    echo "$name: $printed"
    ! grep -q 'Validation\|VUID' <<< "$printed" || { echo "a message of the validation layer" >&2; exit 1; }
    grep -q '^largest difference [01]$' <<< "$printed" || { echo "another picture" >&2; exit 1; }
}
draws wgpu wgpu-host
draws "wgpu with a wall" wgpu-host 4
if [ -n "$with_bevy" ]; then
    # Some of Bevy's crates state a newer compiler than they need.
    (cd ../bevy && cargo build --locked --ignore-rust-version)
    draws Bevy bevy-host
fi
