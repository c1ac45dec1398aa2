#!/usr/bin/env bash
# Runs the tests of the networks on the software device of a newer Mesa, which has cooperative matrices, and under newer
# validation layers; scripts/gpu-compilers/drivers.sh unpacks both. Arguments go to the tests:
#     scripts/test-matrices.sh half
set -euo pipefail
cd "$(dirname "$0")/.."
scripts/gpu-compilers/drivers.sh
root=$(echo "$PWD"/target/gpu-compilers/*-amd64)
libraries=$root/usr/lib/x86_64-linux-gnu
lavapipe=$PWD/target/gpu-compilers/lavapipe.json
printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' \
    "$libraries/libvulkan_lvp.so" > "$lavapipe"
tests=$(cargo test --no-run --test networks --message-format=json-render-diagnostics |
    sed -n '/"profile":{[^}]*"test":true}/s|.*"executable":"\([^"]*\)".*|\1|p')
export VK_DRIVER_FILES=$lavapipe VK_ICD_FILENAMES=$lavapipe VK_LAYER_PATH=$root/usr/share/vulkan/explicit_layer.d
export NIGHTSPLAT_REQUIRE=cooperative-matrices
"$libraries"/ld-linux-*.so.2 --library-path "$libraries" "$tests" "$@"
