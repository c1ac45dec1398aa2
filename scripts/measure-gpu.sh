#!/usr/bin/env bash
# Measures a GPU on a machine that has its driver and nothing else: no compiler, no cargo, no network. Two halves:
#
#     scripts/measure-gpu.sh pack DIR SCENE    where nightsplat is built; SCENE is the folder of a LOM scene
#     DIR/run.sh OUT                           where the GPU is, after copying DIR there
#
# The pack is below 64 MB: the program and the tests without symbols, the Vulkan loader and its validation layer, the
# sources that tests read, the scene. The run takes at most ten minutes, of which each step has a share; a step that
# fails or runs out of time does not stop the others. OUT then contains
#
#     summary.txt   what ran, how it ended and how long it took
#     log.txt       standard error of every step
#     doctor.txt    the devices and their drivers
#     bench.json    kernels, stages and a step, checked against the references
#     tune.json     every tile at 500x375 and 1920x1080, with registers and spills
#     many.json     a million Gaussians at 1080p
#     tune-N.json   the same with subgroups of N lanes, where the device has a choice
#     lom.txt       training by the paper's protocol, plain and with every part: scores, or the last steps
#     gsplat.json   the rasteriser of gsplat, if GSPLAT names a folder to import it from
#     tests.txt     the result of every test binary, and the end of the output of those that failed
#
# Variables and their defaults. pack: PROFILE=release, TESTS (the test targets; all). run: TIME=570 (seconds), and
# BENCH, TUNE, MANY, LOM (arguments of the steps).
set -euo pipefail

MAX_BYTES=64000000

fail() {
    printf '%s\n' "$@" >&2
    exit 1
}

# ---------------------------------------------------------------------------
# Where nightsplat is built

# The executables in cargo's messages, of the targets whose line matches the pattern.
executables() {
    sed -n "/$1/"'s|.*"executable":"\([^"]*\)".*|\1|p'
}

pack() {
    local dir scene stage profile=${PROFILE:-release} messages=--message-format=json-render-diagnostics targets=()
    dir=$(realpath -m "$1") scene=$(realpath "$2")
    [ -d "$scene/low" ] || fail "$scene: is not a LOM scene: it has no folder \`low\`"
    [ ! -e "$dir" ] || [ -z "$(ls -A "$dir")" ] || fail "$dir: is not empty; choose another folder"
    cd "$(dirname "$0")/.."
    for test in ${TESTS:-}; do targets+=(--test "$test"); done
    stage=$(mktemp -d)
    trap "rm -rf '$stage'" EXIT
    mkdir -p "$dir" "$stage"/{lib,layers,scene,source,tests}

    local program tests
    program=$(cargo build --profile "$profile" --bin nightsplat "$messages" | executables '"kind":\["bin"\]')
    tests=$(cargo test --no-run --profile "$profile" "${targets[@]}" "$messages" |
        executables '"profile":{[^}]*"test":true}')
    strip -o "$stage/nightsplat" "$program"
    for test in $tests; do strip -o "$stage/tests/$(basename "$test")" "$test"; done
    # The paths that are compiled into the tests.
    printf '%s\n' "$PWD" "$program" > "$stage/paths"

    local loader layer=VkLayer_khronos_validation
    loader=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | sed -n '0,/libvulkan\.so\.1 /s|.*libvulkan\.so\.1 .*=> ||p')
    cp -L "$loader" "$stage/lib/libvulkan.so.1"
    strip -o "$stage/layers/lib$layer.so" "$(dirname "$loader")/lib$layer.so"
    sed "s|\"lib$layer.so\"|\"./lib$layer.so\"|" "/usr/share/vulkan/explicit_layer.d/$layer.json" \
        > "$stage/layers/$layer.json"

    git ls-files -z | tar --null -T - -c | tar -x -C "$stage/source"
    # The benchmark's preset recognises a scene by the name of its folder.
    cp -RL "$scene" "$stage/scene/"
    local filters=(--lzma2=preset=6,dict=128MiB)
    [ "$(uname -m)" != x86_64 ] || filters=(--x86 "${filters[@]}")
    tar -C "$stage" -c . | xz -T1 "${filters[@]}" > "$dir/pack.tar.xz"
    cp "$0" "$dir/run.sh"

    local bytes
    bytes=$(cat "$dir"/* | wc -c)
    if [ "$bytes" -gt "$MAX_BYTES" ]; then
        (cd "$stage" && du -sk -- * tests/* scene/*/*) | sort -rn >&2
        fail "$dir has $bytes bytes, more than $MAX_BYTES; sizes above in kB before compression; choose fewer TESTS"
    fi
    echo "$dir: $bytes bytes, $(wc -w <<< "$tests") test binaries"
}

# ---------------------------------------------------------------------------
# Where the GPU is

say() {
    printf '%-10s %-14s %4d s\n' "$@" | tee -a "$out/summary.txt"
}

# step NAME FILE LIMIT COMMAND..: appends the command's output to FILE; it has at most LIMIT of the remaining seconds.
step() {
    local name=$1 file=$2 limit=$3 begin=$SECONDS code=0 left=$((end - SECONDS))
    shift 3
    if [ "$left" -lt 3 ]; then
        say "$name" 'no time left' 0
        return
    fi
    printf '\n== %s: %s\n' "$name" "$*" >> "$out/log.txt"
    timeout --kill-after=3 $((limit < left ? limit : left)) "$@" >> "$out/$file" 2>> "$out/log.txt" || code=$?
    case $code in
        0) say "$name" ok $((SECONDS - begin)) ;;
        124 | 137) say "$name" 'out of time' $((SECONDS - begin)) ;;
        *) say "$name" "failed ($code)" $((SECONDS - begin)) ;;
    esac
}

# The machine's loader and driver if found; else the loader of the pack, and a manifest for the driver.
find_vulkan() {
    PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | grep -q 'libvulkan\.so\.1' ||
        export LD_LIBRARY_PATH="$work/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
    export VK_LAYER_PATH=$work/layers
    [ -z "${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}" ] || return 0
    compgen -G '/etc/vulkan/icd.d/*.json' > /dev/null ||
        compgen -G '/usr/share/vulkan/icd.d/*.json' > /dev/null && return 0
    VK_DRIVER_FILES=$(find / -xdev -maxdepth 7 -name 'nvidia_icd*.json' 2> /dev/null | head -n 1 || true)
    if [ -z "$VK_DRIVER_FILES" ]; then
        VK_DRIVER_FILES=$work/nvidia_icd.json
        echo '{"file_format_version": "1.0.0", "ICD": {"library_path": "libGLX_nvidia.so.0", "api_version": "1.3.0"}}' \
            > "$VK_DRIVER_FILES"
    fi
    export VK_DRIVER_FILES
}

# place FROM TO: links TO to FROM, unless TO exists.
place() {
    [ ! -e "$2" ] || return 0
    mkdir -p "$(dirname "$2")" && ln -sfn "$1" "$2" || return
    placed+=("$2")
}

# train NAME LIMIT ARGUMENTS..: trains on the scene; prints its scores, or the last logged steps.
train() {
    local name=$1 limit=$2 run=$work/runs/$1
    shift 2
    printf '\n== %s\n' "$*" >> "$out/lom.txt"
    step "$name" lom.txt "$limit" "$work/nightsplat" train "$work"/scene/* --out "$run" --preset lom "$@"
    if [ -e "$run/metrics.json" ]; then
        cat "$run/metrics.json" >> "$out/lom.txt"
    elif [ -e "$run/train.csv" ]; then
        { head -n 1 "$run/train.csv" && tail -n 3 "$run/train.csv"; } >> "$out/lom.txt"
    fi
}

run_tests() {
    local root program name code begin left result log=$work/test.log all=0 passed=0
    { read -r root && read -r program; } < "$work/paths"
    if ! place "$work/source" "$root" || ! place "$work/nightsplat" "$program" || ! cd "$root"; then
        echo "tests were not run: they need $root and $program" | tee -a "$out/tests.txt" "$out/summary.txt"
        return
    fi
    for test in "$work"/tests/*; do
        [ -e "$test" ] || break
        name=$(basename "$test") begin=$SECONDS left=$((end - SECONDS)) code=0 all=$((all + 1))
        if [ "$left" -lt 3 ]; then
            echo "$name: no time left" >> "$out/tests.txt"
            continue
        fi
        timeout --kill-after=3 $((left < 90 ? left : 90)) "$test" > "$log" 2>&1 || code=$?
        result=$(grep '^test result' "$log" || echo 'no result')
        echo "$name: exit code $code, $((SECONDS - begin)) s; $result" >> "$out/tests.txt"
        if [ "$code" = 0 ]; then passed=$((passed + 1)); else tail -n 60 "$log" >> "$out/tests.txt"; fi
    done
    echo "$passed of $all test binaries pass" | tee -a "$out/tests.txt" "$out/summary.txt"
}

run() {
    end=$((SECONDS + ${TIME:-570}))
    mkdir -p "$1"
    out=$(realpath "$1") work=$(mktemp -d) placed=()
    trap 'rm -rf "$work" ${placed[@]+"${placed[@]}"}' EXIT
    tar -xJf "$(dirname "$0")/pack.tar.xz" -C "$work"
    find_vulkan
    export XDG_CACHE_HOME=$work/cache NIGHTSPLAT_TUNE=off
    local nightsplat=$work/nightsplat

    step doctor doctor.txt 30 "$nightsplat" doctor
    ! command -v nvidia-smi > /dev/null || step nvidia-smi doctor.txt 20 nvidia-smi
    step bench bench.json 60 "$nightsplat" bench --json ${BENCH:-}
    NIGHTSPLAT_TUNE=$work/tiles.json step tune tune.json 120 \
        "$nightsplat" bench --tune --json ${TUNE:---gaussians 100000}
    local size
    for size in $(sed -n 's/.*NIGHTSPLAT_SUBGROUP: or \([0-9, ]*\)).*/\1/p' "$out/doctor.txt" | head -n 1 | tr -d ,); do
        NIGHTSPLAT_SUBGROUP=$size NIGHTSPLAT_TUNE=$work/tiles-$size.json \
            step "tune-$size" "tune-$size.json" 60 "$nightsplat" bench --tune --json ${TUNE:---gaussians 100000}
    done
    # From here on with the fastest tiles.
    export NIGHTSPLAT_TUNE=$work/tiles.json
    step many many.json 60 \
        "$nightsplat" bench --json --unchecked ${MANY:---gaussians 1000000 --width 1920 --height 1080}
    train plain 60 --curve ap3 ${LOM:-}
    [ -z "${GSPLAT:-}" ] ||
        PYTHONPATH=$GSPLAT step gsplat gsplat.json 60 python3 "$work/source/scripts/gsplat-rasteriser.py"
    # The rest of the time is for the networks and the tests.
    train lita $(((end - SECONDS) / 2)) --curve ap3 --model lita ${LOM:-}
    NIGHTSPLAT_TUNE=off run_tests
}

case ${1:-} in
    pack) [ $# -eq 3 ] || fail "usage: $0 pack DIR SCENE" && pack "$2" "$3" ;;
    '' | -*) fail "usage: $0 pack DIR SCENE, then DIR/run.sh OUT" ;;
    *) [ -e "$(dirname "$0")/pack.tar.xz" ] ||
        fail "$0: there is no pack next to it; usage: $0 pack DIR SCENE" && run "$1" ;;
esac
