#!/usr/bin/env bash
# Writes crates/capi/src/nightsplat.h from the Rust beside it with cbindgen; with --verify, fails where it differs.
set -euo pipefail
cd "$(dirname "$0")/.."

version=0.29.4
header=crates/capi/src/nightsplat.h
cbindgen=$(command -v cbindgen || true)
if [ -z "$cbindgen" ] || [ "$("$cbindgen" --version)" != "cbindgen $version" ]; then
    root=target/tools
    [ "$("$root/bin/cbindgen" --version 2> /dev/null)" = "cbindgen $version" ] ||
        cargo install --quiet cbindgen --version "$version" --locked --root "$root"
    cbindgen=$root/bin/cbindgen
fi

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
# One file in the order of the header. What Rust callers must promise, C programmers read from the types.
for part in error device camera model instance image renderer render train; do
    awk '/^\/\/!/ || /^#\[(cfg|path)/ || /^mod / { next }
        /^ *\/\/\/ # Safety/ { skips = 1 }
        !/^ *\/\/\// { skips = 0 }
        !skips' "crates/capi/src/$part.rs"
done | awk '/^\/\/\/$/ { held = $0; next } held { if (/^\/\/\//) print held; held = "" } { print }' > "$folder/capi.rs"
"$cbindgen" --quiet --config crates/capi/src/cbindgen.toml --output "$folder/nightsplat.h" "$folder/capi.rs"

if [ "${1:-}" = --verify ]; then
    diff -u "$header" "$folder/nightsplat.h" || {
        echo "$header is not what cbindgen writes: run scripts/c-header.sh" >&2
        exit 1
    }
else
    cp "$folder/nightsplat.h" "$header"
fi
