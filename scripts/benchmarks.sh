#!/usr/bin/env bash
# Measures the tables of docs/measurements.md and prints them as Markdown.
#
#     scripts/benchmarks.sh [SECTION...] > tables.md
#
# Sections: step tiles quality presets curves targets parts background profile memory growth loading build fisheye
# antialiasing light recolour varying.
# Without a section: all of them, some hours on two cores. Each table is preceded by its date, device and command.
#
# NIGHTSPLAT    the command (default: target/release/nightsplat, built first)
# SCENES        the folder of the LOM scenes; NAMES (chair,sofa,shrub): the measured ones
# LPIPS         the weights of scripts/lpips-weights.py; without them there is no LPIPS
# SEEDS         of quality (1,2,3); DOWNSCALES (2,1): its sizes
# OPTIONS       of every training, overriding its own: OPTIONS="--set steps=20 --set downscale=8" tries a section
# RUNS          folder of the run directories, in which finished runs are reused (default: a temporary folder)
# SIZE          options of `bench`; REPEATS (7) and TUNE_REPEATS (3): of step and tiles
# GROWTH        arguments of examples/growth.rs; PROFILE (release): cargo's profile of growth and build
# VIEWS, POINTS of loading (2000, 100000); STEPS (1500): of fisheye
# SCALE (1): of antialiasing, light, recolour and varying, a factor on the downscale; BRIGHT: the sets of varying
set -euo pipefail
cd "$(dirname "$0")/.."

if [ -z "${NIGHTSPLAT:-}" ]; then
    cargo build --quiet --release --bin nightsplat
    NIGHTSPLAT=${CARGO_TARGET_DIR:-target}/release/nightsplat
fi
NAMES=${NAMES:-chair,sofa,shrub}
SEEDS=${SEEDS:-1,2,3}
DOWNSCALES=${DOWNSCALES:-2,1}
REPEATS=${REPEATS:-7}
read -r -a options <<< "${OPTIONS:-}"
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
RUNS=${RUNS:-$scratch/runs}
# The built-in tiles, not those that `bench --tune` has found on this machine.
export NIGHTSPLAT_TUNE=off

# The command; its standard error is only shown if it fails.
tool() {
    "$NIGHTSPLAT" "$@" 2> "$scratch/log" || {
        cat "$scratch/log" >&2
        return 1
    }
}

# One scene's folder.
scene() { echo "${SCENES:?set SCENES to the folder of the LOM scenes}/$1"; }

# Date, device and command.
stamp() {
    local device
    device=$("$NIGHTSPLAT" doctor --json | sed -n '0,/"name"/ s/^ *"name": "\(.*\)",$/\1/p')
    printf '\n%s, %s, %s cores: `%s`\n\n' "$(date +%F)" "$device" "$(nproc)" "$*"
}

# Trains and scores: train NAME DATASET OPTION...; a finished run is reused.
train() {
    local run=$RUNS/$1 dataset=$2
    shift 2
    mkdir -p "$RUNS"
    tool train "$dataset" --out "$run" --resume --progress none "$@" "${options[@]}" > /dev/null
    [ -s "$run/eval.json" ] || tool eval "$run" --json ${LPIPS:+--lpips "$LPIPS"} > "$run/eval.json"
}

# The figures of a run as cells of a row: figures NAME COLUMN...
figures() {
    python3 - "$RUNS/$1" "${@:2}" << 'PYTHON'
import json, sys
run, columns = sys.argv[1], sys.argv[2:]
found = json.load(open(f"{run}/metrics.json")) | json.load(open(f"{run}/eval.json"))
spent, mean = found["spent"], found["mean"]
residual = found["residual_transmittance"]["mean"]
# The PSNR of another kind of scores, in a file of its own.
other = lambda file, kind: f"{json.load(open(f'{run}/{file}.json'))[kind]['mean']['psnr']:.2f}"
cells = {
    "psnr": lambda: f"{mean['psnr']:.2f}",
    "channel_mean": lambda: f"{mean['psnr_channel_mean']:.2f}",
    "ssim": lambda: f"{mean['ssim']:.4f}",
    "lpips": lambda: f"{mean['lpips']:.4f}" if "lpips" in mean else "-",
    "processor": lambda: f"{spent['processor_seconds']:.1f}",
    "steps": lambda: str(found["steps"]),
    "gaussians": lambda: str(found["gaussians"]),
    "device": lambda: f"{spent['device_bytes'] / 2**20:.0f}",
    "aligned": lambda: other("aligned", "aligned_with_reference"),
    "own": lambda: other("own", "at_own_exposure"),
    "residual": lambda: f"{residual['mean']:.4f}",
    "residual99": lambda: f"{residual['q99']:.3f}",
    "host": lambda: f"{spent['host_bytes'] / 2**20:.0f}",
}
print(" | ".join(cells[column]() for column in columns))
PYTHON
}

# The default training, by scene, size and seed.
section_quality() {
    stamp 'nightsplat train SCENE --downscale D --seed S; nightsplat eval RUN --lpips WEIGHTS'
    echo "| scene | downscale | seed | PSNR, dB | channel mean, dB | SSIM | LPIPS | steps | Gaussians | processor, s |"
    echo "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for downscale in ${DOWNSCALES//,/ }; do
            for seed in ${SEEDS//,/ }; do
                local run=quality-$name-$downscale-$seed
                train "$run" "$(scene "$name")" --downscale "$downscale" --seed "$seed"
                echo "| $name | $downscale | $seed |" \
                    "$(figures "$run" psnr channel_mean ssim lpips steps gaussians processor) |"
            done
        done
    done
}

# The presets, trade-offs of time and quality.
section_presets() {
    stamp 'nightsplat train SCENE --downscale 2 --seed 1 --preset P; nightsplat eval RUN --lpips WEIGHTS'
    echo "| scene | preset | PSNR, dB | SSIM | LPIPS | steps | Gaussians | device, MiB | processor, s |"
    echo "|---|---|---:|---:|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for preset in draft fast balanced best; do
            local run=presets-$name-$preset
            train "$run" "$(scene "$name")" --downscale 2 --seed 1 --preset "$preset"
            echo "| $name | $preset | $(figures "$run" psnr ssim lpips steps gaussians device processor) |"
        done
    done
}

# The default curve, the baseline and the paper's curves.
section_curves() {
    stamp 'nightsplat train SCENE --downscale 4 --steps 1000 --seed 1 --curve C; nightsplat eval RUN --lpips WEIGHTS'
    echo "| scene | curve | PSNR, dB | channel mean, dB | SSIM | LPIPS | processor, s |"
    echo "|---|---|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for curve in "linear --theta 0.49" "ase --gain 3" "ap3 --gain 1" "auto"; do
            local run=curves-$name-${curve%% *} words
            read -r -a words <<< "$curve"
            train "$run" "$(scene "$name")" --downscale 4 --steps 1000 --seed 1 --curve "${words[@]}"
            echo "| $name | $curve | $(figures "$run" psnr channel_mean ssim lpips processor) |"
        done
    done
}

# The targets, without training.
section_targets() {
    stamp 'nightsplat tone apply SCENE --curve C --json'
    echo "| scene | curve | PSNR, dB | channel mean, dB | SSIM |"
    echo "|---|---|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for curve in "linear --theta 0.49" "ase --gain 3" "ap3 --gain 1" "auto"; do
            local words
            read -r -a words <<< "$curve"
            tool tone apply "$(scene "$name")" --curve "${words[@]}" --json > "$scratch/tone.json"
            python3 - "$name" "$curve" "$scratch/tone.json" << 'PYTHON'
import json, sys
name, curve, path = sys.argv[1:]
scene = json.load(open(path))["scene"]
print(f"| {name} | {curve} | {scene['psnr']:.2f} | {scene['psnr_channel_mean']:.2f} | {scene['ssim']:.4f} |")
PYTHON
        done
    done
}

# The parts of LITA-GS, one at a time.
section_parts() {
    stamp 'nightsplat train SCENE --downscale 4 --steps 1000 --seed 1 --plan none --parts P'
    echo "| scene | parts | PSNR, dB | SSIM | LPIPS | Gaussians | processor, s |"
    echo "|---|---|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for parts in none structure tonemapper denoiser structure,tonemapper; do
            local run=parts-$name-$parts
            local chosen=(--parts "$parts")
            [ "$parts" != none ] || chosen=(--model plain)
            train "$run" "$(scene "$name")" --downscale 4 --steps 1000 --seed 1 --plan none "${chosen[@]}"
            echo "| $name | $parts | $(figures "$run" psnr ssim lpips gaussians processor) |"
        done
    done
}

# Training over black or random backgrounds: the background that shows through in the test views.
section_background() {
    stamp 'nightsplat train SCENE --downscale 2 --seed 1 --preset fast --background B'
    echo "| scene | background | PSNR, dB | SSIM | residual transmittance | of 99 % of the pixels, below |"
    echo "|---|---|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for background in black random; do
            local run=background-$name-$background
            train "$run" "$(scene "$name")" --downscale 2 --seed 1 --preset fast --background "$background"
            echo "| $name | $background | $(figures "$run" psnr ssim residual residual99) |"
        done
    done
}

# A camera profile of one scene on every scene, without training.
section_profile() {
    stamp 'nightsplat tone fit SCENE --profile --out P; nightsplat tone apply OTHER --profile P --json'
    echo "| fitted to | ${NAMES//,/ | } |"
    echo "|---|${NAMES//[^,]/}---:|" | sed 's/,/---:|/g'
    for name in ${NAMES//,/ }; do
        tool tone fit "$(scene "$name")" --profile --out "$scratch/$name.toml" > /dev/null
        local row="| $name |"
        for other in ${NAMES//,/ }; do
            tool tone apply "$(scene "$other")" --profile "$scratch/$name.toml" --json > "$scratch/tone.json"
            row+=" $(python3 -c 'import json, sys; print("%.2f |" % json.load(sys.stdin)["scene"]["psnr"])' \
                < "$scratch/tone.json")"
        done
        echo "$row"
    done
}

# Storage precision: memory and scores.
section_memory() {
    stamp 'nightsplat train SCENE --downscale 2 --steps 1000 --seed 1 and the options of the row'
    echo "| scene | options | PSNR, dB | SSIM | Gaussians | device, MiB | host, MiB | processor, s |"
    echo "|---|---|---:|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for chosen in "" "--set precision.rest=32 --set precision.moments=32" "--set precision.photographs=8" \
            "--sh-degree 0" "--cache 1M"; do
            local run words
            run=memory-$name-$(tr -c 'a-z0-9\n' - <<< "$chosen")
            read -r -a words <<< "$chosen"
            train "$run" "$(scene "$name")" --downscale 2 --steps 1000 --seed 1 "${words[@]}"
            echo "| $name | ${chosen:-none} | $(figures "$run" psnr ssim gaussians device host processor) |"
        done
    done
}

# The kernels of a training step, and the whole step.
section_step() {
    stamp "nightsplat bench --unchecked --json --repeats $REPEATS"
    # shellcheck disable=SC2086 # Options.
    tool bench --unchecked --json --repeats "$REPEATS" ${SIZE:-} > "$scratch/bench.json"
    python3 - "$scratch/bench.json" << 'PYTHON'
import json, sys
found = json.load(open(sys.argv[1]))
print(f"{found['intersections']} intersections; a plain training step takes {found['step_ms']:.1f} ms.\n")
print("| kernel | ms |\n|---|---:|")
plain = "adam blend_backward blend_forward emit project project_backward pseudo_gt sort_downsweep sort_upsweep ssim"
for kernel in sorted(plain.split(), key=lambda it: -found["kernels"].get(it, 0)):
    print(f"| {kernel} | {found['kernels'].get(kernel, 0):.2f} |")
PYTHON
}

# The rasteriser with every tile that suits the device.
section_tiles() {
    stamp "nightsplat bench --tune --repeats ${TUNE_REPEATS:-3}"
    echo '```text'
    # shellcheck disable=SC2086 # Options.
    NIGHTSPLAT_TUNE=$scratch/tiles.json tool bench --tune --repeats "${TUNE_REPEATS:-3}" ${SIZE:-}
    echo '```'
}

# Scaling of time and memory of a step with Gaussians, pixels, channels, photographs and points.
section_growth() {
    stamp "cargo run --release --example growth -- ${GROWTH:-}"
    echo '```text'
    # shellcheck disable=SC2086 # Three numbers.
    cargo run --quiet --profile "${PROFILE:-release}" --example growth -- ${GROWTH:-} 2> "$scratch/log"
    echo '```'
}

# From the command to the end of the first step, for many small photographs.
section_loading() {
    local views=${VIEWS:-2000} points=${POINTS:-100000}
    stamp "nightsplat synth SET --views $views --width 64 --height 48; nightsplat train SET --steps 1"
    tool synth "$scratch/many" --views "$views" --width 64 --height 48 > /dev/null
    # The points repeated, each slightly shifted.
    local file=$scratch/many/colmap_sparse/0/points3D.txt
    awk -v want="$points" '/^#/ { print; next } { kept[n++] = $0 }
        END { for (i = 0; i < want; i++) { $0 = kept[i % n]; $1 = i + 1; $2 += 0.001 * int(i / n); print } }' \
        "$file" > "$scratch/points" && mv "$scratch/points" "$file"
    TIMEFORMAT='%R %U %S'
    local taken
    taken=$({ time tool train "$scratch/many" --out "$scratch/loaded" --steps 1 --test-every 0 --progress none \
        > /dev/null; } 2>&1)
    read -r wall user system <<< "$taken"
    echo "| photographs | points | wall, s | processor, s |"
    echo "|---:|---:|---:|---:|"
    echo "| $views | $points | $wall | $(awk "BEGIN { print $user + $system }") |"
}

# A clean build, with crates already downloaded.
section_build() {
    stamp 'cargo build --release --bin nightsplat, into an empty folder'
    TIMEFORMAT='%R %U %S'
    local taken
    cargo fetch --quiet --locked
    taken=$({ time cargo build --quiet --offline --profile "${PROFILE:-release}" --bin nightsplat \
        --target-dir "$scratch/target" > "$scratch/log" 2>&1; } 2>&1)
    read -r wall user system <<< "$taken"
    echo "| wall, s | processor, s |"
    echo "|---:|---:|"
    echo "| $wall | $(awk "BEGIN { print $user + $system }") |"
}

# Training on a fisheye set, native and undistorted.
section_fisheye() {
    stamp "STEPS=${STEPS:-1500} scripts/fisheye.py"
    echo '```text'
    NIGHTSPLAT=$(realpath "$NIGHTSPLAT") STEPS=${STEPS:-1500} scripts/fisheye.py
    echo '```'
}

# The scores of a run at other sizes: sizes RUN DOWNSCALE...; PSNR, and with gain and bias of each channel taken out.
sizes() {
    local run=$RUNS/$1 downscale
    shift
    for downscale in "$@"; do
        tool eval "$run" --downscale "$downscale" --align --json > "$scratch/size.json"
        python3 - "$scratch/size.json" << 'PYTHON'
import json, sys
found = json.load(open(sys.argv[1]))
print(f" {found['mean']['psnr']:.2f} ({found['aligned_with_reference']['mean']['psnr']:.2f}) |", end="")
PYTHON
    done
}

# Antialiasing by the protocol of Mip-Splatting: trained at full size and scored at 1 to 1/8, and the other way round.
section_antialiasing() {
    local scale=${SCALE:-1}
    stamp "nightsplat train SCENE --steps 5000 --set stop.views=0 OPTIONS; nightsplat eval RUN --downscale F --align"
    echo "| scene | trained at | filters | seed | 1 | 1/2 | 1/4 | 1/8 | processor, s |"
    echo "|---|---|---|---:|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for trained in 1 8; do
            for filters in none compensation smoothing both; do
                local own=()
                case $filters in compensation | both) own+=(--antialiasing on) ;; esac
                case $filters in smoothing | both) own+=(--set antialiasing.smoothing=0.2) ;; esac
                for seed in ${SEEDS//,/ }; do
                    local run=antialiasing-$name-$trained-$filters-$seed
                    train "$run" "$(scene "$name")" --seed "$seed" --steps 5000 --set stop.views=0 \
                        --downscale $((trained * scale)) "${own[@]}"
                    echo "| $name | 1/$trained | $filters | $seed |$(sizes "$run" $((scale)) $((2 * scale)) \
                        $((4 * scale)) $((8 * scale))) $(figures "$run" processor) |"
                done
            done
        done
    done
}

# Renders as dark photographs, against the photographs.
section_light() {
    stamp 'nightsplat train SCENE; nightsplat eval RUN --photographs'
    echo "| scene | seed | PSNR of the target, dB | PSNR of the photograph, dB | brighter by, stops |"
    echo "|---|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for seed in ${SEEDS//,/ }; do
            local run=light-$name-$seed
            train "$run" "$(scene "$name")" --seed "$seed" --downscale "${SCALE:-1}"
            tool eval "$RUNS/$run" --photographs --json > "$scratch/light.json"
            python3 - "$name" "$seed" "$scratch/light.json" << 'PYTHON'
import json, sys
name, seed, path = sys.argv[1:]
found = json.load(open(path))
dark = found["as_photographs"]["mean"]
print(f"| {name} | {seed} | {found['mean']['psnr']:.2f} | {dark['psnr']:.2f} | {dark['stops']:+.3f} |")
PYTHON
        done
    done
}

# Night colours on day geometry: the geometry of `high`, the colours of `low`, against everything of `low`.
section_recolour() {
    local frozen=means,quats,scales,opacities
    stamp "nightsplat train SCENE --init DAY.ply --freeze $frozen"
    echo "| scene | training | seed | PSNR, dB | SSIM | LPIPS | steps | Gaussians | processor, s |"
    echo "|---|---|---:|---:|---:|---:|---:|---:|---:|"
    for name in ${NAMES//,/ }; do
        for seed in ${SEEDS//,/ }; do
            local own=(--seed "$seed" --downscale "${SCALE:-1}") bright
            bright=$(scene "$name")
            train "recolour-$name-day-$seed" "$bright" "${own[@]}" --images "$bright/high" --curve none
            train "recolour-$name-night-$seed" "$bright" "${own[@]}"
            train "recolour-$name-frozen-$seed" "$bright" "${own[@]}" --freeze "$frozen" \
                --init "$RUNS/recolour-$name-day-$seed/model.ply"
            for how in night frozen; do
                echo "| $name | $how | $seed |" \
                    "$(figures "recolour-$name-$how-$seed" psnr ssim lpips steps gaussians processor) |"
            done
        done
    done
}

# Exposures that vary: the curves of the paper's third benchmark on sets of our own, against their clean photographs;
# the last column is at the test views' own exposure, which is that of the clean photographs.
section_varying() {
    : "${BRIGHT:?set BRIGHT to datasets in normal light}"
    stamp "nightsplat vary BRIGHT --seed S --stops 2 --gamma 0.8,1.25; nightsplat train SET OPTIONS"
    echo "| set | seed | options | PSNR, dB | aligned | SSIM | LPIPS | processor, s | PSNR at own exposure |"
    echo "|---|---:|---|---:|---:|---:|---:|---:|---:|"
    local bright seed curve name run set own words
    for bright in $BRIGHT; do
        for seed in ${SEEDS//,/ }; do
            set=$RUNS/varying-$(basename "$bright")-$seed
            [ -d "$set" ] || tool vary "$bright" --out "$set" --seed "$seed" --gamma 0.8,1.25 \
                --downscale "${SCALE:-1}" > /dev/null
            for own in "" "linear --theta 0.49" "ase --gain 0" "ap3 --gain 0" auto; do
                for learned in off on; do
                    read -r -a words <<< "${own:+--curve $own --exposure $learned}"
                    [ -n "$own" ] || [ "$learned" = on ] || continue
                    curve=${own%% *}
                    name=varying-$(basename "$bright")-$seed-${curve:-default}-$learned
                    train "$name" "$set" --seed "$seed" "${words[@]}"
                    run=$RUNS/$name
                    tool eval "$run" --align --json > "$run/aligned.json"
                    # After the training, which would begin with it.
                    own_exposures "$set" > "$set/exposures.csv"
                    tool eval "$run" --json > "$run/own.json"
                    rm "$set/exposures.csv"
                    echo "| $(basename "$bright") | $seed | ${words[*]:-none} | $(figures "$name" psnr aligned ssim \
                        lpips processor own) |"
                done
            done
        done
    done
}

# exposures.csv of a varied set: the stops of the training views; test views are clean.
own_exposures() {
    awk -F, 'NR == FNR { sub(/[.]png$/, ""); test[$1] = 1; next }
        FNR == 1 { print "name,ev"; next }
        { print $1 "," (test[$1] ? 0 : $2) }' "$1/test.txt" "$1/varied.csv"
}

sections=(step tiles quality presets curves targets parts background profile memory growth loading build fisheye)
sections+=(antialiasing light recolour varying)
for name in "${@:-${sections[@]}}"; do
    declare -F "section_$name" > /dev/null || { echo "no section $name; there are: ${sections[*]}" >&2; exit 2; }
done
for name in "${@:-${sections[@]}}"; do
    printf '\n## %s\n' "$name"
    "section_$name"
done
