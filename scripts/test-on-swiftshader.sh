#!/usr/bin/env bash
# Runs the tests on SwiftShader, the software device of Debian's chromium: subgroups of four, and no push descriptors.
# Arguments go to `cargo test`:
#     scripts/test-on-swiftshader.sh --test splats
# scripts/known-failures/swiftshader.txt lists the tests that fail there.
set -euo pipefail
cd "$(dirname "$0")/.."
driver=${SWIFTSHADER_ICD:-/usr/lib/chromium/vk_swiftshader_icd.json}
if [ ! -e "$driver" ]; then
    exec scripts/not-run.sh chromium "SwiftShader: there is no $driver (on Debian \`apt install chromium\`)"
fi
# Older loaders know only the second name.
export VK_DRIVER_FILES=$driver VK_ICD_FILENAMES=$driver
status=0
scripts/test-with-known-failures.sh scripts/known-failures/swiftshader.txt "$@" || status=1
scripts/record-driver.sh || status=1
exit "$status"
