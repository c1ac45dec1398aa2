#!/usr/bin/env bash
# Installs each part of a release into an empty Debian and tries it there: scripts/test-release.sh DIR
#
# The program trains the demo and writes its man pages, the C library builds and runs a host from a folder that it was
# moved to, the Python package trains. DIR is what scripts/release.sh wrote. Needs root, and debootstrap, which is
# installed; the mirror is NIGHTSPLAT_MIRROR, or the first of /etc/apt. KEEP=FOLDER keeps the empty Debian for the next
# time.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
release=$(realpath "${1:?name the folder of the release}")
[ "$(id -u)" -eq 0 ] || { exec "$root/scripts/not-run.sh" root 'an empty system is made by root'; }
command -v debootstrap > /dev/null || {
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends debootstrap > /dev/null
} || exec "$root/scripts/not-run.sh" debootstrap 'it could not be installed'

scratch=$(mktemp -d)
# Nothing of the empty system is in use when it is removed.
finish() {
    for system in "$scratch"/*/proc; do umount -l "$system" 2> /dev/null || true; done
    rm -rf --one-file-system "$scratch"
}
trap finish EXIT

# A system has the one file or the folder, and apt reads these names alone.
sources() { cat /etc/apt/sources.list /etc/apt/sources.list.d/*.{list,sources} 2> /dev/null || true; }
mirrors=$(sources | sed -nE 's/^(deb (\[[^]]*\] )?|URIs: )(https?:[^ ]+).*/\3/p')
mirror=${NIGHTSPLAT_MIRROR:-${mirrors%%$'\n'*}}
empty=${KEEP:-$scratch/empty}
# What any of the parts needs from the system: the loader and a device, and what builds a host in C.
packages=libvulkan1,mesa-vulkan-drivers,libgcc-s1,gcc,libc6-dev,libvulkan-dev,pkg-config,cmake,make,python3,python3-venv
if [ ! -e "$empty/etc/debian_version" ]; then
    echo "an empty Debian"
    debootstrap --variant=minbase --include="$packages" bookworm "$empty" "$mirror" \
        > "$scratch/debootstrap.log" 2>&1 || {
        tail -5 "$scratch/debootstrap.log"
        exec "$root/scripts/not-run.sh" debootstrap 'the mirror cannot be reached'
    }
fi

# fresh PART: an empty system of its own, with the release in /release.
fresh() {
    cp -a "$empty" "$scratch/$1"
    mkdir "$scratch/$1/release"
    cp -r "$release"/. "$scratch/$1/release/"
    mount --bind /proc "$scratch/$1/proc"
}
# inside PART SCRIPT: runs it there, as a user would.
inside() {
    chroot "$scratch/$1" /usr/bin/env -i HOME=/root PATH=/usr/local/bin:/usr/bin:/bin NIGHTSPLAT_TUNE=off \
        bash -euo pipefail -c "$2"
}

echo "the program"
fresh program
inside program '
    tar -xzf /release/nightsplat-[0-9]*.tar.gz -C /opt
    cd /opt/nightsplat-*
    test -s LICENSES-THIRD-PARTY.txt && test -s man/man1/nightsplat-train.1 && test -s completions/nightsplat.bash
    ./nightsplat doctor
    ./nightsplat demo --out /tmp/demo --steps 20 > /tmp/demo.log 2>&1 || { cat /tmp/demo.log; exit 1; }
    test -s /tmp/demo/index.html && test -s /tmp/demo/curve=auto/model.html'

echo "the C library, from a folder that it was moved to"
fresh c
cp "$root"/examples/c/embed.c "$root"/examples/c/gpu.h "$scratch/c/root/"
cp "$scratch/program/tmp/demo/curve=auto/model.ply" "$scratch/c/root/"
inside c '
    tar -xzf /release/nightsplat-capi-*.tar.gz -C /tmp
    mv /tmp/nightsplat-capi-* /opt/moved
    cd /root
    export PKG_CONFIG_PATH=/opt/moved/lib/pkgconfig LD_LIBRARY_PATH=/opt/moved/lib
    cc -O1 embed.c -o embed $(pkg-config --cflags --libs nightsplat vulkan) -lm
    ./embed model.ply frame.ppm && test -s frame.ppm
    printf "%s\n" "cmake_minimum_required(VERSION 3.20)" "project(host C)" "find_package(nightsplat REQUIRED)" \
        "find_package(Vulkan REQUIRED)" "add_executable(host embed.c)" \
        "target_link_libraries(host nightsplat::nightsplat Vulkan::Vulkan m)" > CMakeLists.txt
    cmake -B build -DCMAKE_PREFIX_PATH=/opt/moved > /dev/null
    cmake --build build > /dev/null
    ./build/host model.ply again.ppm
    cmp frame.ppm again.ppm'

if compgen -G "$release/*.whl" > /dev/null; then
    echo "the Python package"
    fresh python
    # Its one dependency, for the Python of the empty system.
    tag=$(inside python 'python3 -c "import sys; print(\"%d.%d\" % sys.version_info[:2])"')
    pip download --quiet --only-binary :all: --python-version "$tag" --dest "$scratch/python/release" numpy
    cp "$root/examples/python/first.py" "$scratch/python/root/"
    inside python '
        python3 -m venv /opt/python
        /opt/python/bin/pip install --quiet --no-index --find-links /release /release/nightsplat-*.whl
        cd /root && /opt/python/bin/python first.py'
fi
echo "every part of $release works in an empty Debian"
