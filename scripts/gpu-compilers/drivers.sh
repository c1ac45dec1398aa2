#!/usr/bin/env bash
# Unpacks Mesa's Vulkan drivers from the backports of Debian 13 into target/gpu-compilers/trixie-backports-amd64, with
# what they link to, validation layers, and what stands in for kernel drivers: drm-shim. Of NVIDIA's and Intel's GPUs
# that is built here, from the source of Mesa in Debian 13 itself, which is older: newer drivers run on older kernels
# too. Nothing is installed, and root is not needed. On Debian this takes `apt install gcc dpkg-dev libdrm-dev
# pkg-config python3-mako xz-utils`.
#
# With the argument arm64: the drivers and stand-ins for that processor, of which nothing is built; to use them, `apt
# install qemu-user-static gcc-aarch64-linux-gnu libc6-dev-arm64-cross`.
set -euo pipefail
cd "$(dirname "$0")/../.."
suite=trixie-backports
processor=${1:-amd64}
root=$PWD/target/gpu-compilers/$suite-$processor
[ ! -e "$root/complete" ] || exit 0
rm -rf "$root"
mkdir -p "$root"/{apt,source}

# ---------------------------------------------------------------------------
# Packages, by an apt that knows of no installed ones

mirror=http://deb.debian.org/debian
signed=[signed-by=/usr/share/keyrings/debian-archive-keyring.gpg]
printf "%s $signed $mirror %s main\n" deb $suite deb trixie deb-src trixie > "$root/apt/sources.list"
mkdir -p "$root"/apt/{lists,archives}/partial "$root/apt/none"
: > "$root/apt/status"
apt() {
    apt-get -qq -o Dir::Etc::SourceList="$root/apt/sources.list" -o Dir::Etc::SourceParts="$root/apt/none" \
        -o Dir::State="$root/apt" -o Dir::State::Lists="$root/apt/lists" -o Dir::State::Status="$root/apt/status" \
        -o Dir::Cache="$root/apt" -o Debug::NoLocking=1 -o APT::Sandbox::User="$(id -un)" \
        -o APT::Install-Recommends=0 -o APT::Architecture="$processor" -o APT::Architectures="$processor" "$@"
}
apt update
apt --yes --download-only install --target-release $suite mesa-vulkan-drivers mesa-drm-shim libvulkan1 \
    vulkan-validationlayers > /dev/null
for package in "$root"/apt/archives/*.deb; do dpkg-deb --extract "$package" "$root"; done
if [ "$processor" = arm64 ]; then
    rm -rf "$root"/{apt,source}
    touch "$root/complete"
    exit 0
fi
(cd "$root/source" && apt --download-only source mesa > /dev/null)
tar -xf "$root"/source/mesa_*.orig.tar.xz -C "$root/source" --strip-components=1

# ---------------------------------------------------------------------------
# What stands in for the kernel drivers of newer GPUs than the package knows, and of those it leaves out

cd "$root/source"
# The GPUs since Ampere, by their classes in NVIDIA's open documentation; and what NVK asks of the kernel beside.
sed -i -e 's/^ *case 0x170:/case 0x190: case 0x180:\n&/' \
    -e 's/GA102_3D_CLASS/OF_CHIP(0xc697, 0xc797, 0xcb97, 0xc997)/' \
    -e 's/GA102_COMPUTE_CLASS/OF_CHIP(0xc6c0, 0xc7c0, 0xcbc0, 0xc9c0)/' \
    -e 's/AMPERE_DMA_COPY_A/OF_CHIP(0xc6b5, 0xc7b5, 0xc8b5, 0xc7b5)/' \
    -e '/case NOUVEAU_GETPARAM_GRAPH_UNITS:/i case NOUVEAU_GETPARAM_EXEC_PUSH_MAX: gp->value = 1024; return 0;' \
    -e '/case NOUVEAU_GETPARAM_GRAPH_UNITS:/i case NOUVEAU_GETPARAM_VRAM_BAR_SIZE: gp->value = 3ull << 30; return 0;' \
    -e '/case NOUVEAU_GETPARAM_GRAPH_UNITS:/i case NOUVEAU_GETPARAM_VRAM_USED: gp->value = 0; return 0;' \
    src/nouveau/drm-shim/nouveau_noop.c
chip='device_info.chip_id'
of_chip="OF_CHIP(ga100,ga102,gh100,ad102)=($chip>=0x190?ad102:$chip>=0x180?gh100:$chip==0x170?ga100:ga102)"
(
    cd src/intel/dev
    /usr/bin/python3 gen_wa_helpers.py mesa_defs.json intel_wa.h intel_wa.c
    /usr/bin/python3 intel_device_info_gen_h.py intel_device_info_gen.h
    /usr/bin/python3 intel_device_info_serialize_gen_c.py intel_device_info_serialize_gen.c
)

# shim NAME SOURCE..: with the parts of Mesa that both need.
shim() {
    local name=$1 define defines=() util=() has
    shift
    for has in PTHREAD STRUCT_TIMESPEC FUNC_ATTRIBUTE_PACKED FUNC_ATTRIBUTE_CONST FUNC_ATTRIBUTE_WARN_UNUSED_RESULT \
        __BUILTIN_EXPECT __BUILTIN_UNREACHABLE ENDIAN_H LINUX_FUTEX_H DLADDR DL_ITERATE_PHDR SECURE_GETENV \
        PROGRAM_INVOCATION_NAME MEMFD_CREATE LIBDRM; do
        defines+=("-DHAVE_$has")
    done
    for define in _GNU_SOURCE NDEBUG USE_GCC_ATOMIC_BUILTINS 'PACKAGE_VERSION="0"' "$of_chip"; do
        defines+=("-D$define")
    done
    for has in anon_file blob futex hash_table log memstream os_file os_misc os_time parson ralloc set simple_mtx \
        u_call_once u_debug u_printf u_process vma; do
        util+=("src/util/$has.c")
    done
    gcc -O1 -w -fPIC -shared -fvisibility=hidden "${defines[@]}" -I src -I include -I include/drm-uapi \
        -Isrc/intel -Isrc/intel/common -Isrc/intel/dev -Isrc/intel/dev/i915 -Isrc/util $(pkg-config --cflags libdrm) \
        -Wl,-z,defs -o "$root/usr/lib/x86_64-linux-gnu/lib${name}_noop_drm_shim.so" src/drm-shim/{device,drm_shim}.c \
        src/c11/impl/{threads_posix,time}.c "${util[@]}" "$@" -ldrm -ldl -lpthread -lm
}
shim nouveau src/nouveau/drm-shim/nouveau_noop.c
intel=src/intel/dev
shim intel src/intel/tools/intel_noop_drm_shim.c $intel/intel_{device_info,device_info_serialize_gen}.c \
    $intel/intel_{hwconfig,kmd,wa}.c $intel/{i915,xe}/intel_device_info.c src/intel/common/intel_{gem,engine}.c \
    src/intel/common/{i915,xe}/intel_{gem,engine}.c src/intel/common/xe/intel_device_query.c

rm -rf "$root"/{apt,source}
touch "$root/complete"
