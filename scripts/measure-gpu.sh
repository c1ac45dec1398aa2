#!/usr/bin/env bash
# Measures a GPU on a machine that has its driver and nothing else: no compiler, no cargo, no network.
#
#     scripts/measure-gpu.sh pack DIR SCENE    where nightsplat is built; SCENE is the folder of a LOM scene
#     DIR/run.sh [--software] OUT [SECONDS]    where the GPU is, after copying DIR there; 570 seconds by default
#     scripts/measure-gpu.sh rehearse          both at tiny sizes, on a software device, in three minutes
#
# The pack is below 59 MB: the program and the tests without symbols, the Vulkan loader and its validation layer, the
# libraries that NVIDIA's driver links to, the sources that tests read, the scene. The run decides by itself: what
# counts most comes first, each experiment and each of its steps has a limit, and one that fails or runs out of time
# does not stop the others. Each result is printed at once. It stops where there is no GPU; --software rehearses it on a
# software device, with little of everything and ten times the time for each step. OUT then contains:
#
#     summary.txt       what was printed: each step, how it ended, how long it took and what it found
#     log.txt           standard error of every step
#     results.tar.gz    the rest, as it was after the last experiment:
#         doctor.txt        the devices, their drivers, and the libraries of these
#         clocks.csv        clocks, power, temperature and what limits the clocks, five times a second
#         phases-*.txt      a training with its seconds by phase, with no and with a warm cache of pipelines
#         bench-*.json      512 steps as training submits them, in 32 and 16 bits: small, many, 4 million, and a trained
#                           model; that of many with the device's ceilings
#         pipelines.jsonl   registers, spills and shared memory of every kernel, by the driver
#         ab-*.json         steps of the program and of BASELINE, in turn, in 32 and 16 bits
#         lita-*.jsonl      steps of LITA in single and half precision, with and without crops, and its pipelines
#         tune*.json        every tile and sort: the trained model, the synthetic scene, and subgroups of N lanes
#         checked.json      every pass against its reference: errors in units of their bounds
#         hashes.txt        the models of equal runs, of one without push descriptors, and of one in other batches
#         validation.txt    messages of the validation layer over two steps
#         tests.txt         the result of every test binary, and the end of the output of those that failed
#         gsplat.json       steps of gsplat on the same scene, if GSPLAT names a folder to import it from
#         lom.txt           training by the paper's protocol, plain and with every part: scores, or the last steps
#         growth.txt        how time and memory grow
#
# Variables. pack: PROFILE=release, TESTS (the test targets; all; none), and BASELINE, the program of an earlier commit,
# to compare steps with. run: ONLY, the experiments by the names of their functions (all); GSPLAT.
set -euo pipefail

# A machine may take 64 MiB with the checkout.
MAX_BYTES=59000000

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

    local built program growth tests=
    # At once, so that the features of dependencies, which differ with examples, are those of one build.
    built=$(cargo build --profile "$profile" --bin nightsplat --example growth "$messages")
    program=$(executables '"kind":\["bin"\]' <<< "$built")
    growth=$(executables '"kind":\["example"\]' <<< "$built")
    [ "${TESTS:-}" = none ] ||
        tests=$(cargo test --no-run --profile "${profile/release/checked}" "${targets[@]}" "$messages" |
            executables '"profile":{[^}]*"test":true}')
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

    [ -z "${BASELINE:-}" ] || strip -o "$stage/baseline" "$BASELINE"
    git ls-files -z | tar --null -T - -c | tar -x -C "$stage/source"
    # The benchmark's preset recognises a scene by the name of its folder.
    cp -RL "$scene" "$stage/scene/"
    local filters=(--lzma2=preset="${PRESET:-6}",dict=128MiB)
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

say() { printf '%-22s %-14s %4d s\n' "$@" | tee -a "$out/summary.txt"; }

note() { echo "    $*" | tee -a "$out/summary.txt"; }

# step NAME FILE LIMIT COMMAND..: appends the command's output to FILE; it has at most LIMIT of the remaining seconds.
step() {
    local name=$1 file=$2 limit=$(($3 * patience)) begin=$SECONDS code=0 left=$((until - SECONDS))
    shift 3
    if [ "$left" -lt 3 ]; then
        [ -n "$is_late" ] || say "$name and later" 'no time left' 0
        is_late=yes
        return 1
    fi
    printf '\n== %s: %s\n' "$name" "$*" >> "$out/log.txt"
    timeout --kill-after=3 $((limit < left ? limit : left)) "$@" >> "$found/$file" 2>> "$out/log.txt" || code=$?
    case $code in
        0) say "$name" ok $((SECONDS - begin)) ;;
        124 | 137) say "$name" 'out of time' $((SECONDS - begin)) ;;
        *) say "$name" "failed ($code)" $((SECONDS - begin)) && tail -n 3 "$out/log.txt" ;;
    esac
    return "$code"
}

# experiment LIMIT FUNCTION: runs its steps within LIMIT seconds, and keeps what they found.
experiment() {
    [[ " ${ONLY:-$2} " == *" $2 "* ]] || return 0
    until=$((SECONDS + $1 * patience))
    until=$((until < end ? until : end)) is_late=
    "$2" || true
    tar -czf "$out/.results" -C "$found" . && mv "$out/.results" "$out/results.tar.gz"
}

has_library() { PATH="$PATH:/usr/sbin:/sbin" ldconfig -p | grep -q "$1"; }

add_libraries() { export LD_LIBRARY_PATH="$1${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"; }

# The machine's loader and driver if found; else the loader of the pack, and a manifest for NVIDIA's driver, of which
# either library will do.
find_vulkan() {
    has_library 'libvulkan\.so\.1' || add_libraries "$work/lib"
    has_library 'libXext\.so\.6' || add_libraries "$work/x11"
    # A program of the dev profile would validate what it times.
    export VK_LAYER_PATH=/nonexistent
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
    printf '\n== %s\n' "$*" >> "$found/lom.txt"
    step "$name" lom.txt "$limit" "$work/nightsplat" train "$work"/scene/* --out "$run" --preset lom "$@"
    if [ -e "$run/metrics.json" ]; then
        cat "$run/metrics.json" >> "$found/lom.txt"
        note "$(sed -n '/^  "mean": {/,/^  }/s/^    \("[ps].*\),\{0,1\}$/\1/p' "$run/metrics.json" | tr -d '\n')"
    elif [ -e "$run/train.csv" ]; then
        { head -n 1 "$run/train.csv" && tail -n 3 "$run/train.csv"; } >> "$found/lom.txt"
    fi
}

# equal NAME ARGUMENTS..: the hash of the model of a short run.
equal() {
    local name=$1 run=$work/runs/$1
    shift
    step "$name" hashes.log 20 \
        "$work/nightsplat" train "$work"/scene/* --out "$run" --preset lom --curve ap3 --steps "$EQUAL" "$@"
    if [ -e "$run/model.ply" ]; then
        echo "$(sha256sum < "$run/model.ply" | cut -c 1-16) $name" >> "$found/hashes.txt"
    fi
}

run_tests() {
    local root program name code begin left result log=$work/test.log all=0 passed=0 most=$((90 * patience))
    { read -r root && read -r program; } < "$work/paths"
    if ! place "$work/source" "$root" || ! place "$work/nightsplat" "$program" || ! cd "$root"; then
        echo "tests were not run: they need $root and $program" | tee -a "$found/tests.txt" "$out/summary.txt"
        return
    fi
    # What kernels, renders and training depend on comes first.
    for test in "$work"/tests/{splats,gpu,loss,train}-* "$work"/tests/*; do
        [ -x "$test" ] || continue
        name=$(basename "$test") begin=$SECONDS left=$((until - SECONDS)) code=0 all=$((all + 1))
        if [ "$left" -lt 3 ]; then
            echo "$name: no time left" >> "$found/tests.txt"
            rm "$test"
            continue
        fi
        timeout --kill-after=3 $((left < most ? left : most)) "$test" > "$log" 2>&1 || code=$?
        rm "$test"
        result=$(grep '^test result' "$log" || echo 'no result')
        echo "$name: exit code $code, $((SECONDS - begin)) s; $result" >> "$found/tests.txt"
        if [ "$code" = 0 ]; then
            passed=$((passed + 1))
        else
            note "$name: $result"
            tail -n 60 "$log" >> "$found/tests.txt"
        fi
    done
    echo "$passed of $all test binaries pass" | tee -a "$found/tests.txt" "$out/summary.txt"
}

# value FILE NAME: the first number or text with this name.
value() { sed -n "s/^ *\"$2\": \(.*[^,]\),\{0,1\}$/\1/p" "$found/$1" 2> /dev/null | head -n 1 | tr -d '"'; }

# members FILE NAME: the names and values of an object, the largest first.
members() {
    sed -n "/^  \"$2\": {/,/^  }/s/^    \"\(.*\)\": \([^,]*\),\{0,1\}$/\1 \2/p" "$found/$1" 2> /dev/null | sort -k 2 -gr
}

# timed NAME LIMIT ARGUMENTS..: the steps of a bench, and its longest kernels.
timed() {
    local name=$1 limit=$2
    shift 2
    step "$name" "$name.json" "$limit" \
        "$nightsplat" bench --unchecked --json --warm "$warm" --repeats "$REPEATS" --steady "$STEPS" "$@" || return
    note "a step, ms: $(members "$name.json" steady | awk '/_ms/ { printf "%s %.3f, ", $1, $2 }')" \
        "$(value "$name.json" gaussians) Gaussians, $(value "$name.json" intersections) intersections"
    note "$(members "$name.json" kernels | head -n 8 | awk '{ printf "%s %.3f  ", $1, $2 }')"
}

# Wall time of a training by phase: the second time, its pipelines are known.
phases() {
    local name
    for name in cold warm; do
        step "phases-$name" "phases-$name.txt" 25 "$nightsplat" train "$work"/scene/* --out "$work/runs/trained" \
            --overwrite --progress plain -v ${PHASES:-} || return
        note "$(grep -o 'seconds: .*' "$out/log.txt" | tail -n 1)"
    done
}

# The step of the published figures and that of a training by default, which stores 16 bits.
baseline() {
    local bits
    for bits in 32 16; do
        timed "bench-many-$bits" 25 $MANY --precision $bits $CEILINGS
        timed "bench-small-$bits" 15 $SMALL --precision $bits
        timed "bench-trained-$bits" 15 "$work/runs/trained" --precision $bits
    done
    note "ceilings: $(members bench-many-32.json ceilings | tr '\n' ' ')"
    NIGHTSPLAT_STATISTICS=$found/pipelines.jsonl step pipelines pipelines.txt 30 "$nightsplat" bench --unchecked $MANY
}

# Steps of an earlier program and of this one, in turn.
compared_with_baseline() {
    local size round bits program name
    if [ ! -e "$work/baseline" ]; then
        say 'no BASELINE' packed 0
        return
    fi
    local -A sizes=([many]=$MANY [small]=$SMALL)
    for ((round = 1; round <= ROUNDS; round++)); do
        for size in many small; do
            for bits in 32 16; do
                for program in baseline nightsplat; do
                    name=ab-$size-$bits-$program-$round
                    step "$name" "$name.json" 15 "$work/$program" bench --unchecked --json --warm $((warm / 2)) \
                        --repeats "$REPEATS" --steady $((STEPS / 2)) --precision $bits ${sizes[$size]} || continue
                    note "step, ms: $(members "$name.json" steady | sed -n 's/device_ms//p');" \
                        "$(members "$name.json" kernels | head -n 6 | awk '{ printf "%s %.3f  ", $1, $2 }')"
                done
            done
        done
    done
}

four_million() { timed bench-4-million 45 $MOST; }

# The tiles of a trained model, which has twice the pixels a splat; then its step with the fastest.
trained_tiles() {
    NIGHTSPLAT_TUNE=$work/trained.json tune tune-trained 60 "$work/runs/trained" $TRAINED
    NIGHTSPLAT_TUNE=$work/trained.json timed bench-trained-tuned 15 "$work/runs/trained"
}

# The networks in half precision, on crops, and both. Kernels that do not fit the registers have scratch memory.
lita() {
    local name options half='--denoiser-precision half' crop='--denoiser-crop 128'
    for options in '' "$half" "$crop" "$half $crop"; do
        name=lita$(tr -d ' ' <<< "${options//--denoiser/}")
        NIGHTSPLAT_STATISTICS=$found/$name-pipelines.jsonl step "$name" "$name.jsonl" 40 \
            "$nightsplat" train "$work"/scene/* --out "$work/runs/$name" --preset lom --curve ap3 --model lita \
            --progress json $LITA $options || continue
        note "a step, ms: $(sed -n 's/.*"ms_per_step":\([0-9.]*\).*/\1/p' "$found/$name.jsonl" | tail -n 1);" \
            "with scratch memory: $(grep -v '"scratch":0\.0' "$found/$name-pipelines.jsonl" | grep '"scratch"' |
                sed 's/.*"kernel":"\([^"]*\)".*"scratch":\([0-9.]*\).*/\1 \2/' | sort -u | tr '\n' ' ')"
    done
}

# tune NAME LIMIT ARGUMENTS..
tune() {
    local name=$1 limit=$2
    shift 2
    step "$name" "$name.json" "$limit" "$nightsplat" bench --tune --json --repeats "$REPEATS" "$@" || return
    note "$(sed -n '/^  "tiles": \[/,/^  \]/p; /^  "ssim_strips"/p' "$found/$name.json" | tr -d ' \n')"
}

# Every tile with both sorts; then steps with what was faster.
tiles() {
    local lanes
    NIGHTSPLAT_TUNE=$work/tiles.json tune tune 100 $TUNE
    NIGHTSPLAT_TUNE=$work/tiles.json timed bench-many-tuned 20 $MANY
    NIGHTSPLAT_TUNE=$work/tiles.json timed bench-small-tuned 15 $SMALL
    for lanes in $(sed -n 's/.*NIGHTSPLAT_SUBGROUP: or \([0-9, ]*\)).*/\1/p' "$found/doctor.txt" | tr -d ,); do
        NIGHTSPLAT_SUBGROUP=$lanes NIGHTSPLAT_TUNE=$work/tiles-$lanes.json tune "tune-$lanes" 60 $TUNE
    done
}

checks() {
    if step checked checked.json 60 "$nightsplat" bench --json --repeats 1 ${CHECKED:-}; then
        note "$(value checked.json passes); largest error / bound: $(members checked.json errors | head -n 1)"
    else
        note "$(sed -n '/"disagreeing": \[/,/\]/p' "$found/checked.json" | tr -d ' \n')"
    fi
    equal first
    equal second
    NIGHTSPLAT_PUSH_DESCRIPTORS=off equal sets
    equal batches --hash-every 7
    note "models: $(grep -c . "$found/hashes.txt" || true) runs," \
        "$(cut -d ' ' -f 1 "$found/hashes.txt" 2> /dev/null | sort -u | grep -c . || true) distinct"
    VK_LAYER_PATH=$work/layers VK_INSTANCE_LAYERS=VK_LAYER_KHRONOS_validation \
        VK_LAYER_ENABLES=VK_VALIDATION_FEATURE_ENABLE_SYNCHRONIZATION_VALIDATION_EXT \
        step validation validation.txt 20 "$nightsplat" train "$work"/scene/* --out "$work/runs/validated" \
        --preset lom --curve ap3 --steps 2
    note "$(grep -c 'Validation Error\|SYNC-HAZARD' "$found/validation.txt" || true) messages"
}

compared() {
    [ -n "${GSPLAT:-}" ] || return 0
    "$nightsplat" bench --unchecked --repeats 1 $MANY --ply "$work/bench.ply" > /dev/null
    PYTHONPATH=$GSPLAT step gsplat gsplat.json 50 \
        python3 "$work/source/scripts/gsplat-rasteriser.py" --ply "$work/bench.ply"
}

# The rest of the time is for training, for the networks, and for growth.
training() {
    train lom-plain 40 --curve ap3 ${LOM:-}
    train lom-lita $(((end - SECONDS) / 2 / patience)) --curve ap3 --model lita ${LOM:-}
    step growth growth.txt 60 "$work/growth" ${software:+64 48 100}
}

run() {
    local software=
    patience=1 warm=2
    if [ "$1" = --software ]; then
        software=yes patience=10 warm=0
        shift
        local little='--gaussians 300 --width 64 --height 48'
        MANY=$little SMALL=$little MOST=$little TUNE=$little CHECKED=$little
        TRAINED='--width 64 --height 48' STEPS=2 EQUAL=5 ROUNDS=1 REPEATS=1 CEILINGS=
        PHASES='--downscale 8 --steps 10' LITA='--downscale 8 --steps 3' LOM='--steps 5 --downscale 8'
    fi
    : "${MANY=--gaussians 1000000 --width 1920 --height 1080}" "${SMALL=--gaussians 50000 --width 500 --height 375}"
    : "${MOST=--gaussians 4000000 --width 1920 --height 1080}"
    : "${TUNE=--gaussians 100000}" "${TRAINED=--width 500 --height 375}" "${LITA=--steps 60}"
    : "${STEPS=512}" "${EQUAL=300}" "${ROUNDS=3}" "${REPEATS=9}" "${CEILINGS=--ceilings}"
    end=$((SECONDS + ${2:-570} * patience)) until=$((SECONDS + 60 * patience)) is_late=
    mkdir -p "$1"
    out=$(realpath "$1") work=$(mktemp -d) placed=() clocks=
    trap '[ -z "$clocks" ] || kill "$clocks"; rm -rf "$work" ${placed[@]+"${placed[@]}"}' EXIT
    tar -xJf "$(dirname "$0")/pack.tar.xz" -C "$work"
    found=$work/found nightsplat=$work/nightsplat
    mkdir "$found"
    find_vulkan
    export XDG_CACHE_HOME=$work/cache NIGHTSPLAT_TUNE=off

    libraries > "$found/doctor.txt" 2>&1 || true
    step doctor doctor.txt 30 "$nightsplat" doctor || true
    if command -v nvidia-smi > /dev/null; then
        step nvidia-smi doctor.txt 20 nvidia-smi || true
        local queried=timestamp,clocks.sm,clocks.mem,power.draw,temperature.gpu,clocks_event_reasons.active
        nvidia-smi -lms 200 --format=csv --query-gpu="$queried" \
            > "$found/clocks.csv" 2>> "$out/log.txt" &
        clocks=$!
    fi
    case $(kind) in
        discrete | integrated | virtual) ;;
        software) [ -n "$software" ] || fail "there is no GPU: see $out/log.txt; or rehearse with --software" ;;
        *) cat "$found/doctor.txt" && fail "no device is found" ;;
    esac

    # What counts most comes first: times, without checks. Not here, for want of settings: the lengths of segments.
    experiment 60 phases
    experiment 120 baseline
    experiment 150 compared_with_baseline
    experiment 50 four_million
    experiment 80 trained_tiles
    experiment 120 lita
    experiment 160 tiles
    # From here on with the fastest tiles.
    export NIGHTSPLAT_TUNE=$work/tiles.json
    experiment 120 checks
    VK_LAYER_PATH=$work/layers NIGHTSPLAT_TUNE=off experiment 120 run_tests
    experiment 60 compared
    experiment "$((end - SECONDS))" training
}

# The program and one test binary of the dev profile, a synthetic scene, and a run of all experiments.
rehearse() {
    local dir status=0
    dir=$(mktemp -d)
    # shellcheck disable=SC2064
    trap "rm -rf '$dir'" EXIT
    cargo build --bin nightsplat --example growth
    "${CARGO_TARGET_DIR:-target}/debug/nightsplat" synth "$dir/chair" --views 9 --width 256 --height 192 > /dev/null
    export BASELINE=${CARGO_TARGET_DIR:-target}/debug/nightsplat
    PRESET=0 PROFILE=dev TESTS=house "$0" pack "$dir/pack" "$dir/chair"
    "$dir/pack/run.sh" --software "$dir/out"
    ! grep -E 'failed|out of time|no time left' "$dir/out/summary.txt" || status=1
    tar -tzf "$dir/out/results.tar.gz" | sort
    exit "$status"
}

case ${1:-} in
    pack) [ $# -eq 3 ] || fail "usage: $0 pack DIR SCENE" && pack "$2" "$3" ;;
    rehearse) rehearse ;;
    --software | [!-]*) [ -e "$(dirname "$0")/pack.tar.xz" ] ||
        fail "$0: there is no pack next to it; usage: $0 pack DIR SCENE" && run "$@" ;;
    *) fail "usage: $0 pack DIR SCENE, then DIR/run.sh [--software] OUT [SECONDS]; or $0 rehearse" ;;
esac
