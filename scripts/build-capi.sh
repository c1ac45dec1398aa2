#!/usr/bin/env bash
# Builds the C library and lays it out for hosts: scripts/build-capi.sh DIR [CARGO OPTIONS]
#
#   DIR/include/nightsplat.h
#   DIR/lib/libnightsplat.so -> libnightsplat.so.0, and libnightsplat.a
#   DIR/lib/pkgconfig/nightsplat.pc, DIR/lib/cmake/nightsplat/nightsplat-config.cmake
#
# DIR may be moved. Without options it is a renderer; `--features train` adds training and the formats beside PLY. From
# a checkout the kernels are compiled, which needs C++; an archive holds them compiled.
set -euo pipefail

[ $# -ge 1 ] || {
    echo "usage: scripts/build-capi.sh DIR [CARGO OPTIONS]" >&2
    exit 2
}
mkdir -p "$1"
out=$(cd "$1" && pwd)
shift
cd "$(dirname "$0")/.."

profile=${NIGHTSPLAT_PROFILE:-release}
# A checkout may hold the kernels of an earlier package.
features=glslang
[ -e .git ] || [ ! -d precompiled ] || features=
built=${CARGO_TARGET_DIR:-target}/$([ "$profile" = dev ] && echo debug || echo "$profile")
options=(-p nightsplat-capi --profile "$profile" --lib --no-default-features --features "$features" "$@")

version=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -n 1)
# Every 0.x may break its callers, so the name has the minor version; from 1 on the major one.
case $version in
    0.*) abi=0.$(cut -d. -f2 <<< "$version") ;;
    *) abi=${version%%.*} ;;
esac

mkdir -p "$out/include" "$out/lib/pkgconfig" "$out/lib/cmake/nightsplat"
# Both kinds of library are made of one compilation; optimised as a whole they are a quarter smaller.
export CARGO_PROFILE_RELEASE_LTO=fat CARGO_PROFILE_RELEASE_CODEGEN_UNITS=1 CARGO_PROFILE_RELEASE_INCREMENTAL=false
kinds=cdylib
[ "$profile" != release ] || kinds=cdylib,staticlib
cargo rustc "${options[@]}" --crate-type "$kinds" -- -C "link-arg=-Wl,-soname,libnightsplat.so.$abi"
install -m 755 "$built/libnightsplat_capi.so" "$out/lib/libnightsplat.so.$abi"
ln -sf "libnightsplat.so.$abi" "$out/lib/libnightsplat.so"
if [ "$profile" = release ]; then
    strip --strip-unneeded "$out/lib/libnightsplat.so.$abi"
    install -m 644 "$built/libnightsplat_capi.a" "$out/lib/libnightsplat.a"
fi
install -m 644 crates/capi/src/nightsplat.h "$out/include/nightsplat.h"
fill() { sed -e "s|@VERSION@|$version|; s|@ABI@|$abi|" "$1" > "$2"; }
fill crates/capi/src/nightsplat.pc.in "$out/lib/pkgconfig/nightsplat.pc"
fill crates/capi/src/nightsplat-config.cmake.in "$out/lib/cmake/nightsplat/nightsplat-config.cmake"
flags="PKG_CONFIG_PATH=$out/lib/pkgconfig pkg-config --cflags --libs nightsplat vulkan"
echo "wrote $out; build a host with: cc host.c \$($flags)"
