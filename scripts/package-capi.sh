#!/usr/bin/env bash
# Builds the C library and packs it for a release, on Linux: scripts/package-capi.sh TARGET [CARGO OPTIONS] writes
# dist/nightsplat-capi-VERSION-TARGET.tar.gz with library, header, pkg-config and CMake files, the contract and a host,
# and its checksum. Unpacked anywhere, it is a prefix.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:?name the target, such as x86_64-unknown-linux-gnu}
shift

version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
name=nightsplat-capi-$version-$target
rm -rf "dist/$name"
scripts/build-capi.sh "dist/$name" "$@"
docs=dist/$name/share/doc/nightsplat
mkdir -p "$docs"
cp LICENSE-APACHE LICENSE-MIT docs/embedding.md examples/c/embed.c "$docs/"
cd dist
tar -czf "$name.tar.gz" "$name"
sha256sum "$name.tar.gz" > "$name.tar.gz.sha256"
cat "$name.tar.gz.sha256"
