#!/usr/bin/env bash
# Compiles the kernels with the compilers of GPUs that are not there, and compares registers, spills, memory and
# instructions with docs/gpu-compilers/ARCHITECTURE.json:
#
#     scripts/test-on-gpu-compilers.sh [--write] [ARCHITECTURE..]
#
# Without an architecture: navi21 and vega20, 32 and 64 lanes, by the RADV that is installed. By the drivers that
# scripts/gpu-compilers/drivers.sh unpacks: navi31 and gfx1201 (AMD), sm80 and sm90 (NVIDIA), dg2-8, dg2-16 and dg2-32
# (Intel, of which the number is the lanes), and adreno730 (Qualcomm, by an emulated processor, which takes minutes).
#
# A refused kernel and a new spill are failures, and so is a kernel that is not in the list, or no longer compiled; a
# tenth more instructions is a warning. --write writes the lists. NIGHTSPLAT is the command (default: the dev build).
set -euo pipefail
cd "$(dirname "$0")/.."
write=()
if [ "${1:-}" = --write ]; then
    write=(--write)
    shift
fi
[ $# -gt 0 ] || set -- navi21 vega20

work=target/gpu-compilers
mkdir -p "$work" docs/gpu-compilers
work=$(realpath "$work")
nightsplat=${NIGHTSPLAT:-${CARGO_TARGET_DIR:-target}/debug/nightsplat}
[ -n "${NIGHTSPLAT:-}" ] || [ -x "$nightsplat" ] || cargo build
installed=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | sed -n '0,/libvulkan\.so\.1 /s|.*libvulkan\.so\.1 .*=> ||p')
installed=$(dirname "$installed")
if [ ! -e "$installed/libvulkan_radeon.so" ]; then
    exec scripts/not-run.sh radv 'the compilers of GPUs: there is no RADV (on Debian `apt install mesa-vulkan-drivers`)'
fi
cc -O1 -Wall -Wextra -shared -fPIC -o "$work/null-device.so" scripts/gpu-compilers/null-device.c -ldl
printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' \
    "$work/null-device.so" > "$work/null-device.json"

# run ARCHITECTURE COMMAND..: on the null device with the compiler of the architecture.
run() {
    local architecture=$1 root=$work/trixie-backports-amd64 program driver shim own=() set=()
    shift
    case $architecture in
        navi21 | vega20) root='' driver=radeon set=(RADV_FORCE_FAMILY="${architecture^^}") ;;
        navi31 | gfx1201) driver=radeon shim=amdgpu set=(AMDGPU_GPU_ID="$architecture") ;;
        sm80) driver=nouveau shim=nouveau set=(NOUVEAU_CHIPSET=170) ;;
        sm90) driver=nouveau shim=nouveau set=(NOUVEAU_CHIPSET=180 NVK_I_WANT_A_BROKEN_VULKAN_DRIVER=1) ;;
        dg2-*) driver=intel shim=intel set=(INTEL_STUB_GPU_PLATFORM=dg2 NIGHTSPLAT_SUBGROUP="${architecture#dg2-}") ;;
        *) echo "$architecture: no such architecture" >&2 && return 1 ;;
    esac
    local libraries=$installed
    if [ -n "$root" ]; then
        scripts/gpu-compilers/drivers.sh
        libraries=$root/usr/lib/$(uname -m)-linux-gnu
        program=$(command -v "$1")
        shift
        shim=$libraries/lib${shim}_noop_drm_shim.so
        own=("$libraries"/ld-linux-*.so.2 --library-path "$libraries" --preload "$shim" "$program")
    fi
    # No layer, no cache that has the results of before, no tiles but the built-in ones, and no test of the results.
    env "${set[@]}" NULL_DEVICE_DRIVER="$libraries/libvulkan_$driver.so" VK_DRIVER_FILES="$work/null-device.json" \
        VK_ICD_FILENAMES="$work/null-device.json" VK_LAYER_PATH=/nonexistent XDG_CACHE_HOME="$work/cache" \
        MESA_SHADER_CACHE_DISABLE=true NIGHTSPLAT_TUNE=off NIGHTSPLAT_DEVICE_TEST=off "${own[@]}" "$@"
}

# Compiles what the bench uses, and what else training does; the older devices have no matrices of the half precision.
compile() {
    run "$1" "$nightsplat" bench --unchecked --repeats 1 --gaussians 1000 || return
    local train=(train "$work/set" --out "$work/run" --overwrite --plan none --steps 2 --sh-degree 3)
    run "$1" "$nightsplat" "${train[@]}" --model plain --exposure on --set loss.opacity_weight=0.01 || return
    run "$1" "$nightsplat" "${train[@]}" --model plain --parts lamp,normals || return
    # A given model of which colours alone are trained.
    cp "$work/run/model.ply" "$work/model.ply" || return
    local frozen=(--init "$work/model.ply" --freeze means,quats,scales,opacities)
    run "$1" "$nightsplat" "${train[@]}" --model plain "${frozen[@]}" || return
    case $1 in navi21 | vega20) return 0 ;; esac
    # The width of the presets, and the paper's. No depth: the set has no maps, so its kernels would be compiled ahead,
    # until that is known, and be as many as chance has it.
    local half=(--model lita --parts denoiser,tonemapper,structure --denoiser-precision half)
    run "$1" "$nightsplat" "${train[@]}" "${half[@]}" || return
    run "$1" "$nightsplat" "${train[@]}" "${half[@]}" --denoiser-channels 64
}

# The kernels of another device with 64 lanes, by Turnip, whose drivers are for another processor.
compile_elsewhere() {
    local libraries=$work/trixie-backports-arm64/usr/lib/aarch64-linux-gnu kernels=$work/kernels
    scripts/gpu-compilers/drivers.sh arm64 || return
    aarch64-linux-gnu-gcc -O1 -idirafter /usr/include -o "$work/compile-arm64" scripts/gpu-compilers/compile.c \
        "$libraries/libvulkan.so.1" -Wl,--allow-shlib-undefined || return
    printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' \
        "$libraries/libvulkan_freedreno.so" > "$work/freedreno.json"
    rm -rf "$kernels"
    mkdir "$kernels"
    local lines=$NIGHTSPLAT_STATISTICS
    NIGHTSPLAT_STATISTICS=$kernels/lines NULL_DEVICE_KERNELS=$kernels compile vega20 || return
    scripts/gpu-compilers/elsewhere.py "$kernels/lines" "$kernels" qemu-aarch64-static \
        -E LD_PRELOAD="$libraries/libfreedreno_noop_drm_shim.so" -E FD_GPU_ID=730 \
        -E VK_DRIVER_FILES="$work/freedreno.json" -E MESA_SHADER_CACHE_DISABLE=true \
        "$libraries/ld-linux-aarch64.so.1" --library-path "$libraries" "$work/compile-arm64" > "$lines"
}

if [ ! -e "$work/set/normals" ]; then
    rm -rf "$work/set"
    "$nightsplat" synth "$work/set" --views 3 --width 64 --height 48 > /dev/null
    # Any image is a mask, and a map of normals.
    cp -r "$work/set/high" "$work/set/masks"
    cp -r "$work/set/high" "$work/set/normals"
fi
status=0
for architecture in "$@"; do
    statistics=$work/$architecture.jsonl
    rm -f "$statistics"
    compile=compile
    [ "$architecture" != adreno730 ] || compile=compile_elsewhere
    if ! NIGHTSPLAT_STATISTICS=$statistics "$compile" "$architecture" > "$work/$architecture.log" 2>&1; then
        tail -n 5 "$work/$architecture.log"
        echo "failed: $architecture: the kernels do not compile"
        status=1
        continue
    fi
    scripts/gpu-compilers/ledger.py "${write[@]}" "docs/gpu-compilers/$architecture.json" "$statistics" || status=1
done
exit "$status"
