#!/usr/bin/env bash
# Packs the crate with compiled kernels as dist/nightsplat-VERSION.crate, with its checksum: without the feature
# `glslang`, it builds without a C++ compiler. The kernels stay in precompiled/ for `cargo publish --allow-dirty`: git
# ignores that folder, which cargo treats as uncommitted. Builds the package once in this way, on one core, and prints
# the processor time. Option --allow-dirty also packs uncommitted changes.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target}

if [ "${1:-}" != --allow-dirty ] && [ -n "$(git status --porcelain)" ]; then
    echo "there are uncommitted changes; commit them, or pass --allow-dirty" >&2
    exit 1
fi

# Fails unless a build ends with an error of one line that matches.
refuses() {
    if cargo build --lib --locked --no-default-features 2> "$scratch/error.log"; then
        echo "failed: a build without kernels, or with those of other sources" >&2
        exit 1
    fi
    grep "^error: .*$1.*; build with --features glslang" "$scratch/error.log"
}

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
rm -rf precompiled
refuses "the kernels are not compiled"
compiled=$(cargo check --lib --locked --no-default-features --features glslang \
    --message-format=json-render-diagnostics |
    sed -n '/"reason":"build-script-executed","package_id":"path+/s|.*"out_dir":"\([^"]*\)".*|\1|p')
mkdir precompiled
# Former kernels may still be there.
grep -o '[a-z0-9_]*\.spv' "$compiled/kernels.rs" | while read -r name; do cp "$compiled/$name" precompiled/; done
cp "$compiled/kernels.rs" "$compiled/sources.hash" precompiled/
cargo package --quiet --locked --offline --no-verify --allow-dirty
version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
crate=nightsplat-$version.crate
package=$CARGO_TARGET_DIR/package/$crate

tar -xf "$package" -C "$scratch"
cd "$scratch/nightsplat-$version"
diff -r "$root/precompiled" precompiled
if cargo tree --offline --locked --no-default-features --edges normal,build --prefix none |
    grep -E '^(cc|cmake|glslang|shaderc|spirq)'; then
    echo "failed: the package builds C++ without the feature glslang" >&2
    exit 1
fi
export CARGO_TARGET_DIR=$scratch/target CARGO_INCREMENTAL=0
TIMEFORMAT="built without C++ in %U s of processor time and %S s of the system's"
time cargo build --quiet --offline --locked --no-default-features --jobs 1
diff -r precompiled "$(dirname "$(find "$CARGO_TARGET_DIR" -path '*/out/kernels.rs')")"
# A shader that is not the one that was compiled is no silent mistake.
echo "// Changed." >> shaders-glsl/splats/render/blend_forward.comp
refuses "the kernels in precompiled/ are not those of shaders-glsl"

cd "$root"
mkdir -p dist
cp "$package" dist/
cd dist
if command -v sha256sum > /dev/null; then sha256sum "$crate"; else shasum -a 256 "$crate"; fi | tee "$crate.sha256"
