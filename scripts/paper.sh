#!/usr/bin/env bash
# Makes a table or a figure of the paper from a folder with its data: tables as Markdown, CSV and LaTeX, figures as SVG.
#
#     scripts/paper.sh lom|realx3d|varying|curves|offset|alpha|gain|histogram DIR [--quick]
#
# DIR has a folder for each scene, named as in the paper: for `varying` scenes in normal light, for the others dark ones
# with references. Scenes that are absent are left out, and named. `--quick` rehearses a part in a minute: tiny
# synthetic scenes, written to DIR, and some steps. docs/paper.md has the figures of the paper beside ours.
#
#   lom        table 1: linear, ASE and AP3 on LOM, and the default; also the targets without training
#   realx3d    table 2: the same on RealX3D; with LPIPS, by the protocol of RealX3D's authors too
#   varying    table 3: the same on scenes whose exposures are varied
#   curves     table 5 and figure 2: every curve on one scene, with the offset .103; the curves of the paper, drawn
#   offset     table 6, figures 6 and 9: black levels, fixed and adaptive; black level and pairs of each scene
#   alpha      table 7, upper part: AP3 with other alpha
#   gain       table 7, lower part: ASE with other gains
#   histogram  figure 7: the distribution of values before and after the curves, and its skewness
#
# NIGHTSPLAT   the command (default: target/release/nightsplat, built first)
# OUT          the folder to write to (default: paper); a finished training in it is reused
# LPIPS        AlexNet's weights, LPIPS_VGG VGG-16's, of scripts/lpips-weights.py; without them there is no LPIPS
# SCENES       the scenes, separated by commas, instead of the paper's
# OPTIONS      of every training, overriding its own: OPTIONS="--steps 500 --downscale 4"
set -euo pipefail

part=${1:?a part of the paper: lom, realx3d, varying, curves, offset, alpha, gain or histogram}
data=${2:?the folder with the scenes}
quick=${3:-}
root=$(cd "$(dirname "$0")/.." && pwd)
if [ -z "${NIGHTSPLAT:-}" ]; then
    cargo build --quiet --release --bin nightsplat --manifest-path "$root/Cargo.toml"
    NIGHTSPLAT=${CARGO_TARGET_DIR:-$root/target}/release/nightsplat
fi
out=${OUT:-paper}/$part
mkdir -p "$out"
read -r -a options <<< "${OPTIONS:-}"
with_lpips=(${LPIPS:+--lpips "$LPIPS"})
development=Chocolate,Cupcake,GearWorks,Laboratory
case $part in
    lom) names=buu,chair,sofa,bike,shrub ;;
    realx3d) names=BlueHawaii,Chocolate,Cupcake,GearWorks,Laboratory,MilkCookie,Popcorn,Sculpture,Ujikintoki ;;
    varying) names=bicycle,bonsai,counter,garden,kitchen,room,stump ;;
    curves) names=BlueHawaii ;;
    offset) names=buu,bike,chair,shrub,sofa ;;
    alpha | gain) names=$development ;;
    histogram) names=BlueHawaii,Chocolate ;;
    *) echo "there is no part $part of the paper; see the header of $0" >&2 && exit 2 ;;
esac
names=${SCENES:-$names}
if [ -n "$quick" ]; then
    [ "$quick" = --quick ] || { echo "the third argument is $quick; it may be --quick" >&2 && exit 2; }
    names=one,two
    for seed in 1 2; do
        name=$(cut -d, -f "$seed" <<< "$names")
        [ -d "$data/$name" ] ||
            "$NIGHTSPLAT" synth "$data/$name" --width 64 --height 48 --views 16 --seed "$seed" > "$out/log.txt"
    done
    options+=(--steps 20)
fi

# OPTIONS override a part's own.
length=(--steps 5000) half=(--downscale 2)
case " ${options[*]} " in *" --steps "*) length=() ;; esac
case " ${options[*]} " in *" --downscale "*) half=() ;; esac

scenes=()
for name in ${names//,/ }; do
    if [ -d "$data/$name" ]; then scenes+=("$data/$name"); else echo "without $name, which is not in $data"; fi
done
[ ${#scenes[@]} -gt 0 ] || { echo "$data has none of $names" >&2 && exit 3; }

# The command; its standard error is only shown if it fails.
tool() {
    "$NIGHTSPLAT" "$@" 2> "$out/log.txt" || { cat "$out/log.txt" >&2 && return 1; }
}

# A sweep over the scenes into OUT/NAME: sweep NAME OPTION... Of one scene, the tables are in its own folder.
sweep() {
    local to=$out/$1
    shift
    tool sweep "${scenes[@]}" --out "$to" "$@" "${with_lpips[@]}" "${options[@]}" > /dev/null
    if [ ${#scenes[@]} -gt 1 ]; then
        cat "$to/scenes.md"
    else
        latex "$to/leaderboard.csv" "$to/leaderboard.tex"
        cat "$to/leaderboard.md"
    fi
    for scene in "${scenes[@]}"; do
        local folder=$to
        [ ${#scenes[@]} -eq 1 ] || folder=$to/$(basename "$scene")
        figure "$folder/index.html" "$folder/figure.svg"
    done
}

# A table as LaTeX: latex FILE.csv FILE.tex
latex() {
    python3 - "$@" << 'PYTHON'
import csv, re, sys
rows = csv.reader(open(sys.argv[1], newline=""))
escaped = lambda cell: re.sub(r"([&%$#_{}])", r"\\\1", cell)
open(sys.argv[2], "w").writelines(" & ".join(map(escaped, row)) + r" \\" + "\n" for row in rows)
PYTHON
}

# The first chart of a page as a file: figure PAGE.html FILE.svg
figure() {
    python3 - "$@" << 'PYTHON'
import re, sys
page = open(sys.argv[1], encoding="utf-8").read()
chart = re.search(r"<figure class=\"plot\">(<svg .*?</svg>)", page, re.S)
if chart:
    colours = re.search(r"<style>(.*?)\* \{", page, re.S)
    style = f"<style>\n{colours.group(1)}</style>\n" if colours else ""
    begin = '<svg xmlns="http://www.w3.org/2000/svg" style="background: var(--ground)" font-family="sans-serif" '
    svg = chart.group(1).replace("<svg ", begin, 1).replace(">\n", ">\n" + style, 1)
    open(sys.argv[2], "w", encoding="utf-8").write(svg)
PYTHON
}

# Measurements of targets without training, a row for each scene and curve: measured FILE KEY... [-- OPTION...]
measured() {
    local file=$1 keys=()
    shift
    while [ $# -gt 0 ] && [ "$1" != -- ]; do keys+=("$1") && shift; done
    [ $# -eq 0 ] || shift
    echo "scene,curve$(printf ',%s' "${keys[@]}")" > "$file.csv"
    for scene in "${scenes[@]}"; do
        for curve in linear ase ap3 auto; do
            tool tone apply "$scene" --curve "$curve" --json > "$out/tone.json" "$@"
            python3 - "$(basename "$scene")" "$curve" "$out/tone.json" "${keys[@]}" >> "$file.csv" << 'PYTHON'
import json, sys
scene, curve, path, *keys = sys.argv[1:]
found = json.load(open(path))["scene"]
value = lambda key: found.get("after", {}).get(key[6:]) if key.startswith("after_") else found.get(key)
print(",".join([scene, curve] + [f"{value(key):.4f}" if value(key) is not None else "" for key in keys]))
PYTHON
        done
    done
    latex "$file.csv" "$file.tex"
    sed 's/,/ | /g; s/.*/| & |/' "$file.csv" | sed "1a\\$(printf '|---%.0s' 1 2 "${keys[@]}")|" | tee "$file.md"
}

case $part in
    lom)
        measured "$out/targets" psnr psnr_channel_mean ssim
        sweep paper --presets lom --curves linear,ase,ap3
        sweep default --presets balanced
        ;;
    realx3d)
        sweep paper --presets realx3d --curves linear,ase,ap3
        sweep default --presets balanced
        if [ -n "${LPIPS_VGG:-}" ]; then
            echo "by the protocol of RealX3D's authors: SSIM with a uniform window of 7x7, LPIPS by VGG-16"
            find "$out" -name metrics.json -printf '%h\n' | sort | while read -r run; do
                echo "${run#"$out/"}"
                tool eval "$run" --uniform-ssim --lpips "$LPIPS_VGG" | grep '^mean\|^view'
            done | tee "$out/authors.txt"
        fi
        ;;
    varying)
        varied=()
        for scene in "${scenes[@]}"; do
            to=$out/sets/$(basename "$scene")
            [ -d "$to" ] || tool vary "$scene" --out "$to" --stops 2 --gamma 0.8,1.25 > /dev/null
            varied+=("$to")
        done
        scenes=("${varied[@]}")
        sweep paper --presets mip360-varying --curves linear,ase,ap3
        sweep default --presets balanced
        ;;
    curves)
        tool tone list linear ase ap3 --dataset "${scenes[0]}" --plot "$out/curves.svg" > /dev/null
        scenes=("${scenes[0]}")
        # A rehearsal has three of the 37 curves.
        sweep paper --table leaderboard --offset 0.103 "${half[@]}" ${quick:+--curves softexp,ase,ap3}
        ;;
    offset)
        for scene in "${scenes[@]}"; do
            tool tone fit "$scene" --plot "$out/pairs-$(basename "$scene").svg" > /dev/null
        done
        measured "$out/black" p90 r delta0
        scenes=("${scenes[0]}")
        sweep paper --table offset --presets lom
        ;;
    alpha) sweep paper --table alpha --presets realx3d "${length[@]}" ;;
    gain) sweep paper --table gain --presets realx3d "${length[@]}" ;;
    histogram)
        measured "$out/skewness" skewness after_skewness
        for scene in "${scenes[@]}"; do
            name=$(basename "$scene")
            tool tone apply "$scene" --curve ap3 --compare ase,linear --report "$out/$name.html" > /dev/null
            figure "$out/$name.html" "$out/$name.svg"
        done
        ;;
esac
