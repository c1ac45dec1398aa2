#!/usr/bin/env bash
# Builds the image of Containerfile and trains the demo's scene in it, on the image's software device. Needs root and
# buildah, no daemon and no privileges beyond a chroot. A base image that cannot be pulled is built by debootstrap from
# the same packages.
set -euo pipefail
cd "$(dirname "$0")/.."
export BUILDAH_ISOLATION=chroot STORAGE_DRIVER=${STORAGE_DRIVER:-vfs}

base=$(sed -n 's/^FROM \(.*\) AS build$/\1/p' Containerfile)
if ! buildah inspect --type image "$base" > /dev/null 2>&1 && ! buildah pull "$base"; then
    suite=${base#*:}
    root=$(mktemp -d)
    trap 'rm -rf "$root"' EXIT
    # The script of sid, since debootstrap may be older than the suite.
    debootstrap --variant=minbase "${suite%-slim}" "$root" "" /usr/share/debootstrap/scripts/sid
    # Certificates of this machine, such as those of a proxy.
    mkdir -p "$root/usr/local/share/ca-certificates"
    find /usr/local/share/ca-certificates -name '*.crt' -exec cp {} "$root/usr/local/share/ca-certificates/" \;
    # A mirror's index may be older than its expiry date.
    echo 'Acquire::Check-Valid-Until "false";' > "$root/etc/apt/apt.conf.d/99-mirror"
    made=$(buildah from scratch)
    buildah add --quiet "$made" "$root" /
    buildah commit --quiet "$made" "$base"
    buildah rm "$made"
fi

buildah build --pull=never --tag nightsplat .
container=$(buildah from --pull=never nightsplat)
inside() {
    echo "\$ nightsplat $*"
    buildah run "$container" -- nightsplat "$@"
}
inside doctor
inside demo --out demo
inside eval demo/curve=ap3
buildah rm "$container" > /dev/null
echo "the image builds, and trains the demo's scene"
