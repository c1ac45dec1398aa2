#!/usr/bin/env bash
# Measures a GPU on a machine that has its driver and nothing else: no compiler, no cargo, no network. Two halves:
#
#     scripts/measure-gpu.sh pack DIR SCENE    where nightsplat is built; SCENE is the folder of a LOM scene
#     DIR/run.sh [--software] OUT              where the GPU is, after copying DIR there
#
# The pack is below 64 MB: the program and the tests without symbols, the Vulkan loader and its validation layer, the
# libraries that NVIDIA's driver links to, the sources that tests read, the scene. The run takes at most ten minutes, of
# which each step has a share; a step that fails or runs out of time does not stop the others. It stops at once where
# there is no GPU; --software rehearses it on a software device, with little of everything and ten times the time for
# each step. OUT then contains, in order:
#
#     summary.txt       what ran, how it ended and how long it took; at the end, ten lines of results
#     log.txt           standard error of every step
#     doctor.txt        the devices, their drivers, and the libraries of these
#     clocks.csv        clocks, power, temperature and what limits the clocks, five times a second
#     bench.json        kernels, stages, a step and the device's ceilings, unchecked
#     pipelines.jsonl   registers, spills and shared memory of every kernel, by the driver
#     many.json         a million Gaussians at 1080p
#     tune.json         every tile at 500x375 and 1920x1080, with registers and spills
#     tune-N.json       the same with subgroups of N lanes, where the device has a choice
#     steady-*.json     512 steps as training submits them, at two sizes: wall, device, passes, processor
#     checked.json      every pass against its reference: errors in units of their bounds
#     hashes.txt        the models of equal runs, of one without push descriptors, and of one in other batches
#     validation.txt    messages of the validation layer over two steps
#     tests.txt         the result of every test binary, and the end of the output of those that failed
#     gsplat.json       steps of gsplat on the same scene, if GSPLAT names a folder to import it from
#     lom.txt           training by the paper's protocol, plain and with every part: scores, or the last steps
#     growth.txt        how time and memory grow
#
# Variables and their defaults. pack: PROFILE=release, TESTS (the test targets; all). run: TIME=570 (seconds; 5700), and
# BENCH, TUNE, MANY, SMALL, CHECKED, LOM (arguments of the steps), STEPS=512 (of the steady ones), EQUAL=300 (of the
# runs that must be equal).
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
    mkdir -p "$dir" "$stage"/{lib,layers,scene,source,tests,x11}

    local program growth tests
    program=$(cargo build --profile "$profile" --bin nightsplat "$messages" | executables '"kind":\["bin"\]')
    tests=$(cargo test --no-run --profile "$profile" "${targets[@]}" "$messages" |
        executables '"profile":{[^}]*"test":true}')
    growth=$(cargo build --profile "$profile" --example growth "$messages" | executables '"kind":\["example"\]')
    strip -o "$stage/nightsplat" "$program"
    strip -o "$stage/growth" "$growth"
    for test in $tests; do strip -o "$stage/tests/$(basename "$test")" "$test"; done
    # The paths that are compiled into the tests.
    printf '%s\n' "$PWD" "$program" > "$stage/paths"

    local loader layer=VkLayer_khronos_validation
    loader=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | sed -n '0,/libvulkan\.so\.1 /s|.*libvulkan\.so\.1 .*=> ||p')
    cp -L "$loader" "$stage/lib/libvulkan.so.1"
    strip -o "$stage/layers/lib$layer.so" "$(dirname "$loader")/lib$layer.so"
    sed "s|\"lib$layer.so\"|\"./lib$layer.so\"|" "/usr/share/vulkan/explicit_layer.d/$layer.json" \
        > "$stage/layers/$layer.json"

    # NVIDIA's driver links to these, which few containers have.
    local library
    for library in libX11.so.6 libXext.so.6 libxcb.so.1 libXau.so.6 libXdmcp.so.6 libbsd.so.0 libmd.so.0; do
        if [ -e "$(dirname "$loader")/$library" ]; then cp -L "$(dirname "$loader")/$library" "$stage/x11/"; fi
    done

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
    local name=$1 file=$2 limit=$(($3 * patience)) begin=$SECONDS code=0 left=$((end - SECONDS))
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

has_library() { PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | grep -q "$1"; }

add_libraries() { export LD_LIBRARY_PATH="$1${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"; }

# The machine's loader and driver if found; else the loader of the pack, and a manifest for NVIDIA's driver, of which
# either library will do.
find_vulkan() {
    has_library 'libvulkan\.so\.1' || add_libraries "$work/lib"
    has_library 'libXext\.so\.6' || add_libraries "$work/x11"
    export VK_LAYER_PATH=$work/layers
    [ -z "${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}" ] || return 0
    compgen -G '/etc/vulkan/icd.d/*.json' > /dev/null ||
        compgen -G '/usr/share/vulkan/icd.d/*.json' > /dev/null && return 0
    VK_DRIVER_FILES=$(find / -xdev -maxdepth 7 -name 'nvidia_icd*.json' 2> /dev/null | head -n 1 || true)
    local library
    for library in GLX EGL; do
        [ -z "$VK_DRIVER_FILES" ] || break
        local manifest=$work/nvidia_$library.json path=lib${library}_nvidia.so.0
        printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' "$path" \
            > "$manifest"
        ! VK_DRIVER_FILES=$manifest "$work/nightsplat" doctor > /dev/null 2>&1 || VK_DRIVER_FILES=$manifest
    done
    export VK_DRIVER_FILES=${VK_DRIVER_FILES:-$work/nvidia_EGL.json}
}

# What a driver that is not found needs to be found.
libraries() {
    local path
    echo "NVIDIA_DRIVER_CAPABILITIES=${NVIDIA_DRIVER_CAPABILITIES:-} VK_DRIVER_FILES=${VK_DRIVER_FILES:-}"
    ls /etc/vulkan/icd.d /usr/share/vulkan/icd.d 2> /dev/null || true
    PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | sed -n 's/.*lib\(GLX\|EGL\)_nvidia\.so\.0 .*=> //p' |
        while read -r path; do echo "$path:" && ldd "$path"; done
}

# The kind of the device that would run.
kind() {
    local devices chosen
    devices=$("$work/nightsplat" doctor --json 2> /dev/null) || true
    chosen=$(sed -n 's/^  "chosen": \([0-9]*\).*/\1/p' <<< "$devices")
    sed -n 's/^      "kind": "\(.*\)",$/\1/p' <<< "$devices" | sed -n "$((${chosen:-0} + 1))p"
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

# equal NAME ARGUMENTS..: the hash of the model of a short run.
equal() {
    local name=$1 run=$work/runs/$1
    shift
    step "$name" hashes.log 20 \
        "$work/nightsplat" train "$work"/scene/* --out "$run" --preset lom --curve ap3 --steps "$EQUAL" "$@"
    if [ -e "$run/model.ply" ]; then
        echo "$(sha256sum < "$run/model.ply" | cut -c 1-16) $name" >> "$out/hashes.txt"
    fi
}

run_tests() {
    local root program name code begin left result log=$work/test.log all=0 passed=0 most=$((90 * patience))
    local tests_end=$((SECONDS + $1 * patience))
    tests_end=$((tests_end < end ? tests_end : end))
    { read -r root && read -r program; } < "$work/paths"
    if ! place "$work/source" "$root" || ! place "$work/nightsplat" "$program" || ! cd "$root"; then
        echo "tests were not run: they need $root and $program" | tee -a "$out/tests.txt" "$out/summary.txt"
        return
    fi
    # What kernels, renders and training depend on comes first.
    for test in "$work"/tests/{splats,gpu,loss,train}-* "$work"/tests/*; do
        [ -x "$test" ] || continue
        name=$(basename "$test") begin=$SECONDS left=$((tests_end - SECONDS)) code=0 all=$((all + 1))
        if [ "$left" -lt 3 ]; then
            echo "$name: no time left" >> "$out/tests.txt"
            rm "$test"
            continue
        fi
        timeout --kill-after=3 $((left < most ? left : most)) "$test" > "$log" 2>&1 || code=$?
        rm "$test"
        result=$(grep '^test result' "$log" || echo 'no result')
        echo "$name: exit code $code, $((SECONDS - begin)) s; $result" >> "$out/tests.txt"
        if [ "$code" = 0 ]; then passed=$((passed + 1)); else tail -n 60 "$log" >> "$out/tests.txt"; fi
    done
    echo "$passed of $all test binaries pass" | tee -a "$out/tests.txt" "$out/summary.txt"
}

# value FILE NAME: the first number or text with this name.
value() { sed -n "s/^ *\"$2\": \(.*[^,]\),\{0,1\}$/\1/p" "$out/$1" 2> /dev/null | head -n 1 | tr -d '"'; }

# members FILE NAME: the names and values of an object, the largest first.
members() {
    sed -n "/^  \"$2\": {/,/^  }/s/^    \"\(.*\)\": \([^,]*\),\{0,1\}$/\1 \2/p" "$out/$1" 2> /dev/null | sort -k 2 -gr
}

# Ten lines of results.
results() {
    local copy hashes small many name ms file
    copy=$(members bench.json ceilings | sed -n 's/copy_gb_per_s //p')
    small=$(members steady-small.json steady) many=$(members steady-many.json steady)
    hashes=$(cut -d ' ' -f 1 "$out/hashes.txt" 2> /dev/null | sort -u | grep -c . || true)
    for file in bench.json many.json checked.json; do [ -z "$(value "$file" device)" ] || break; done
    echo "device: $(value "$file" device), $(value "$file" driver)"
    echo "ceilings: $(members bench.json ceilings | tr '\n' ' ')"
    echo "step, ms: 20 000 at 512x384: $(value bench.json step_ms)"
    echo "step, ms: 50 000 at 500x375: $(tr '\n' ' ' <<< "$small")"
    echo "step, ms: 1 000 000 at 1080p: $(tr '\n' ' ' <<< "$many")"
    members many.json kernels | head -n 5 | while read -r name ms; do
        members many.json gb_per_s_at_most | awk -v name="$name" -v ms="$ms" -v copy="${copy:-0}" \
            '$1 == name { printf "%s %.3f ms, %.0f %% of the copy; ", name, ms, (copy > 0 ? 100 * $2 / copy : 0) }'
    done
    echo
    echo "tiles: $(cat "$work/tiles.json" 2> /dev/null | tr -d ' \n' | sed 's/.*"tiles"://')"
    echo "$(value checked.json passes); largest error / bound: $(members checked.json errors | head -n 1)"
    echo "$(awk '/"disagreeing": \[/ { on = 1 } on { print } on && /\]/ { exit }' "$out/checked.json" 2> /dev/null |
        tr -d ' \n')"
    echo "models: $(grep -c . "$out/hashes.txt" 2> /dev/null || true) runs, $hashes distinct"
    echo "validation: $(grep -c 'Validation Error\|SYNC-HAZARD' "$out/validation.txt" 2> /dev/null || true) messages;" \
        "tests: $(tail -n 1 "$out/tests.txt" 2> /dev/null || true)"
}

run() {
    local software=
    patience=1
    if [ "$1" = --software ]; then
        software=yes patience=10
        shift
        local little='--gaussians 500 --width 128 --height 96 --repeats 1'
        : "${BENCH:=$little}" "${SMALL:=$little}" "${CHECKED:=$little}" "${MANY:=$little}" "${TUNE:=$little}"
        : "${STEPS:=4}" "${EQUAL:=10}" "${LOM:=--steps 10 --downscale 8}"
    fi
    local size many=${MANY:---gaussians 1000000 --width 1920 --height 1080}
    local small=${SMALL:---gaussians 50000 --width 500 --height 375} warm=2
    [ -z "$software" ] || warm=0
    : "${TUNE:=--gaussians 100000}" "${STEPS:=512}" "${EQUAL:=300}"
    end=$((SECONDS + ${TIME:-$((570 * patience))}))
    mkdir -p "$1"
    out=$(realpath "$1") work=$(mktemp -d) placed=() clocks=
    trap '[ -z "$clocks" ] || kill "$clocks"; rm -rf "$work" ${placed[@]+"${placed[@]}"}' EXIT
    tar -xJf "$(dirname "$0")/pack.tar.xz" -C "$work"
    find_vulkan
    export XDG_CACHE_HOME=$work/cache NIGHTSPLAT_TUNE=off
    local nightsplat=$work/nightsplat

    libraries > "$out/doctor.txt" 2>&1 || true
    step doctor doctor.txt 30 "$nightsplat" doctor
    if command -v nvidia-smi > /dev/null; then
        step nvidia-smi doctor.txt 20 nvidia-smi
        local queried=timestamp,clocks.sm,clocks.mem,power.draw,temperature.gpu,clocks_event_reasons.active
        nvidia-smi -lms 200 --format=csv --query-gpu="$queried" \
            > "$out/clocks.csv" 2>> "$out/log.txt" &
        clocks=$!
    fi
    case $(kind) in
        discrete | integrated | virtual) ;;
        software) [ -n "$software" ] || fail "there is no GPU: see $out/doctor.txt; or rehearse with --software" ;;
        *) fail "no device is found: see $out/doctor.txt" ;;
    esac

    # What counts most comes first.
    NIGHTSPLAT_STATISTICS=$out/pipelines.jsonl step pipelines pipelines.log 30 \
        "$nightsplat" bench --unchecked --json ${BENCH:-}
    step bench bench.json 30 "$nightsplat" bench --unchecked --json --ceilings --warm $warm ${BENCH:-}
    step many many.json 30 "$nightsplat" bench --unchecked --json --warm $warm $many
    NIGHTSPLAT_TUNE=$work/tiles.json step tune tune.json 100 "$nightsplat" bench --tune --json $TUNE
    for size in $(sed -n 's/.*NIGHTSPLAT_SUBGROUP: or \([0-9, ]*\)).*/\1/p' "$out/doctor.txt" | head -n 1 | tr -d ,); do
        NIGHTSPLAT_SUBGROUP=$size NIGHTSPLAT_TUNE=$work/tiles-$size.json \
            step "tune-$size" "tune-$size.json" 60 "$nightsplat" bench --tune --json $TUNE
    done
    # From here on with the fastest tiles.
    export NIGHTSPLAT_TUNE=$work/tiles.json
    step steady-small steady-small.json 15 \
        "$nightsplat" bench --unchecked --json --warm $warm --steady "$STEPS" $small
    step steady-many steady-many.json 30 \
        "$nightsplat" bench --unchecked --json --warm $warm --steady "$STEPS" --ply "$work/bench.ply" $many
    step checked checked.json 60 "$nightsplat" bench --json ${CHECKED:-}

    equal first
    equal second
    NIGHTSPLAT_PUSH_DESCRIPTORS=off equal sets
    equal batches --hash-every 7
    VK_INSTANCE_LAYERS=VK_LAYER_KHRONOS_validation \
        VK_LAYER_ENABLES=VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT \
        step validation validation.txt 20 "$nightsplat" train "$work"/scene/* --out "$work/runs/validated" \
        --preset lom --curve ap3 --steps 2
    NIGHTSPLAT_TUNE=off run_tests 120
    [ -z "${GSPLAT:-}" ] || PYTHONPATH=$GSPLAT step gsplat gsplat.json 50 \
        python3 "$work/source/scripts/gsplat-rasteriser.py" --ply "$work/bench.ply"
    train plain 40 --curve ap3 ${LOM:-}
    # The rest of the time is for the networks and for growth.
    train lita $(((end - SECONDS) / 2 / patience)) --curve ap3 --model lita ${LOM:-}
    step growth growth.txt 60 "$work/growth" ${software:+64 48 100}
    results | tee -a "$out/summary.txt"
}

case ${1:-} in
    pack) [ $# -eq 3 ] || fail "usage: $0 pack DIR SCENE" && pack "$2" "$3" ;;
    --software | [!-]*) [ -e "$(dirname "$0")/pack.tar.xz" ] ||
        fail "$0: there is no pack next to it; usage: $0 pack DIR SCENE" && run "$@" ;;
    *) fail "usage: $0 pack DIR SCENE, then DIR/run.sh [--software] OUT" ;;
esac
