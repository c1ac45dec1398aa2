#!/usr/bin/env bash
# Night captures: what scenes and cameras at night do to the targets. Prints a Markdown table.
#
#     scripts/night.sh [--train] [KIND...]
#
# A kind is `plain`, or options of `nightsplat synth` joined by +, such as street+sky; without one, those of
# docs/night.md, in about two minutes of processor time. --train adds the PSNR of a training of STEPS (150) steps.
#
# NIGHTSPLAT    the command (default: target/release/nightsplat, built first)
# SETS          the folder of the sets, in which they are kept and reused (default: a temporary folder)
set -euo pipefail
cd "$(dirname "$0")/.."
if [ -z "${NIGHTSPLAT:-}" ]; then
    cargo build --quiet --release --bin nightsplat
    NIGHTSPLAT=${CARGO_TARGET_DIR:-target}/release/nightsplat
fi
scratch=$(mktemp -d) && : > "$scratch/lines"
trap '[ $? -eq 0 ] || cat "$scratch/lines" >&2; rm -rf "$scratch"' EXIT
training=
[ "${1:-}" != --train ] || { training=1 && shift; }
[ $# -gt 0 ] || set -- plain sky street-lamp sky+street-lamp headlights haze haze+street-lamp street street+sky \
    street+sky+street-lamp+headlights fall-off bands date night-mode raised-black one-channel brackets
export NIGHTSPLAT_TUNE=off # the built-in tiles

# The row of a kind, from the files of its commands: row KIND SCRATCH.
row() {
    python3 - "$@" << 'PYTHON'
import json, pathlib, sys
kind, scratch = sys.argv[1], pathlib.Path(sys.argv[2])
read = lambda name: json.loads((scratch / name).read_text())
applied, right, found = read("applied"), read("references")["scene"], read("diagnosis")
scene, right = applied["scene"], right["after"]
after = scene["after"]
def pair(name, digits, factor=1):
    return f"{factor * after[name]:.{digits}f} ({factor * right[name]:.{digits}f})"
lines = [line[6:] for line in (scratch / "lines").read_text().splitlines() if line.startswith(" WARN ")]
plan = [name for name, row in found["plan"].items() if isinstance(row, dict) and row.get("on")]
said = [*dict.fromkeys(lines), *found["remarks"]]
cells = [kind, f"{scene['psnr']:.2f}", pair("mean_luminance", 3), pair("near_white_fraction", 1, 100),
         f"{applied['exposure']['gain']:.1f}"]
trained = [f"{read('scores')['mean']['psnr']:.2f}"] if (scratch / "scores").exists() else []
print("|", " | ".join([*cells, *trained, ", ".join(plan), "; ".join(said)]), "|", flush=True)
PYTHON
}

trained=${training:+ trained, dB |}
echo "| kind | PSNR, dB | mean (reference) | near white, % (reference) | gain |$trained plan | remarks |"
echo "|---|---:|---:|---:|---:|${training:+---:|}---|---|"
for kind; do
    set=${SETS:-$scratch/sets}/$kind
    read -r -a options <<< "$(sed -E 's/^|\+/ --/g; s/--plain//; s/--street( |$)/--street 3\1/' <<< "$kind")"
    [ -d "$set" ] || "$NIGHTSPLAT" synth "$set" "${options[@]}" > /dev/null
    {
        "$NIGHTSPLAT" tone apply "$set" --json > "$scratch/applied"
        "$NIGHTSPLAT" tone apply "$set/high" --json > "$scratch/references" 2> /dev/null
        "$NIGHTSPLAT" diagnose "$set" --json > "$scratch/diagnosis"
        if [ -n "$training" ]; then
            "$NIGHTSPLAT" train "$set" --out "$scratch/run" --steps "${STEPS:-150}" --overwrite > /dev/null
            "$NIGHTSPLAT" eval "$scratch/run" --json > "$scratch/scores"
        fi
    } 2> "$scratch/lines"
    row "$kind" "$scratch"
done
