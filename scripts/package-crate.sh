#!/usr/bin/env bash
# Packs the crates as dist/*.crate, with their checksums. That of the root has the kernels compiled: without the feature
# `glslang`, it builds without a C++ compiler. The kernels stay in precompiled/ for `cargo publish --workspace
# --allow-dirty`: git ignores that folder, which cargo treats as uncommitted. Builds the packages once in this way,
# and prints the processor time. Option --allow-dirty also packs uncommitted changes.
set -euo pipefail
cd "$(dirname "$0")/.."
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$PWD/target} CARGO_INCREMENTAL=0

if [ "${1:-}" != --allow-dirty ] && [ -n "$(git status --porcelain)" ]; then
    echo "there are uncommitted changes; commit them, or pass --allow-dirty" >&2
    exit 1
fi
scratch=$(mktemp -d)
# `cargo package` unpacks the crates into its home, in a folder named after that of the packages.
tidy() {
    local unpacked=${CARGO_HOME:-$HOME/.cargo}/registry/src
    find "$unpacked" -mindepth 1 -maxdepth 1 -name "-*" -newer "$scratch" -exec rm -rf {} +
    rm -rf "$scratch"
}
trap tidy EXIT

# Fails unless a build ends with an error of one line that matches.
refuses() {
    if cargo check --lib --locked --no-default-features 2> "$scratch/error.log"; then
        echo "failed: a build without kernels, or with those of other sources" >&2
        exit 1
    fi
    grep "^error: .*$1.*; build with --features glslang" "$scratch/error.log"
}

rm -rf precompiled
refuses "the kernels are not compiled"
compiled=$(cargo check --lib --locked --no-default-features --features glslang \
    --message-format=json-render-diagnostics |
    sed -n '/"reason":"build-script-executed","package_id":"path+/s|.*"out_dir":"\([^"]*\)".*|\1|p')
mkdir precompiled
# Kernels of an earlier version may be in the folder.
grep -o '[a-z0-9_]*\.spv' "$compiled/kernels.rs" | while read -r name; do cp "$compiled/$name" precompiled/; done
cp "$compiled/kernels.rs" precompiled/
# Kernels of other shaders are refused.
echo 0 > precompiled/sources.hash
refuses "the kernels in precompiled/ are not those of shaders-glsl"
cp "$compiled/sources.hash" precompiled/
if cargo tree --offline --locked --no-default-features --edges normal,build --prefix none |
    grep -E '^(cc|cmake|glslang|shaderc|spirq)'; then
    echo "failed: the package builds C++ without the feature glslang" >&2
    exit 1
fi

# cargo neither unpacks nor compiles a version of a crate twice in one folder, and a crate may have changed since. Debug
# information takes a third of the build.
export CARGO_TARGET_DIR=$scratch/packaged CARGO_PROFILE_DEV_DEBUG=0
TIMEFORMAT="packed, and built without C++ in %U s of processor time and %S s of the system's"
time cargo package --quiet --workspace --locked --offline --allow-dirty --no-default-features
mkdir -p dist
cp "$CARGO_TARGET_DIR"/package/nightsplat*.crate dist/
cd dist
for crate in nightsplat*.crate; do
    if command -v sha256sum > /dev/null; then sha256sum "$crate"; else shasum -a 256 "$crate"; fi | tee "$crate.sha256"
done
