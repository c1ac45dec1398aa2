#!/usr/bin/env bash
# Night captures: what scenes and cameras at night do to the targets. Prints a Markdown table.
#
#     scripts/night.sh [--train] [KIND...]
#
# A kind is a set of `nightsplat synth`; without a name, all of them, in about three minutes on two cores. A row has the
# PSNR of the targets of `tone apply` against the references, their mean luminance and share of values from 250 of 255
# on, with those of the references, the gain, and what `diagnose` remarks. --train adds the PSNR of a training.
#
# NIGHTSPLAT    the command (default: target/release/nightsplat, built first)
# SETS          the folder of the sets, in which they are kept and reused (default: a temporary folder)
# STEPS         of a training (150)
set -euo pipefail
cd "$(dirname "$0")/.."
if [ -z "${NIGHTSPLAT:-}" ]; then
    cargo build --quiet --release --bin nightsplat
    NIGHTSPLAT=${CARGO_TARGET_DIR:-target}/release/nightsplat
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
training=
[ "${1:-}" != --train ] || { training=1 && shift; }
export NIGHTSPLAT_TUNE=off # the built-in tiles

# The options of a kind are its name, or these.
declare -A options=(
    [plain]="" [sky+lamp]="--sky --street-lamp" [haze+lamp]="--haze --street-lamp" [street]="--street 3"
    [street+sky]="--street 3 --sky" [street+night]="--street 3 --sky --street-lamp --headlights"
)
all=(plain sky street-lamp sky+lamp headlights haze haze+lamp street street+sky street+night
    fall-off bands date night-mode raised-black one-channel brackets)

# The row of a kind, of its set and the files of the scratch folder.
row() {
    python3 - "$@" << 'PYTHON'
import json, pathlib, sys, zlib

kind, references, scratch = sys.argv[1], *map(pathlib.Path, sys.argv[2:])
mean = lambda numbers: sum(numbers) / len(numbers)
read = lambda name: json.loads((scratch / name).read_text())

def rows(png):
    """The rows of bytes of an 8-bit RGB image."""
    parts, at = {b"IDAT": b""}, 8
    while at < len(png):
        end, name = at + 8 + int.from_bytes(png[at:at + 4], "big"), png[at + 4:at + 8]
        parts[name], at = parts.get(name, b"") + png[at + 8:end], end + 4
    raw, stride = zlib.decompress(parts[b"IDAT"]), 3 * int.from_bytes(parts[b"IHDR"][:4], "big")
    above = bytes(stride)
    for start in range(0, len(raw), stride + 1):
        kind, row = raw[start], bytearray(raw[start + 1:start + 1 + stride])
        for i in range(stride if kind else 0):
            a, b, c = (row[i - 3], above[i], above[i - 3]) if i > 2 else (0, above[i], 0)
            paeth = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            row[i] = row[i] + (0, a, b, (a + b) // 2, paeth)[kind] & 255
        above = row
        yield row

def light(folder):
    """The mean luminance of a folder's images, and their share of values near white."""
    values = b"".join(row for path in sorted(folder.glob("*.png")) for row in rows(path.read_bytes()))
    weighted = zip((0.2126, 0.7152, 0.0722), (values[channel::3] for channel in range(3)))
    return sum(weight * mean(plane) for weight, plane in weighted) / 255, 100 * mean([b >= 250 for b in values])

(target, white), (right, right_white) = light(scratch / "targets"), light(references)
applied, found = read("applied"), read("diagnosis")
said = ["curve " + ("on" if found["plan"]["curve"]["on"] else "off"), *found["remarks"]]
cells = [kind, f"{mean([view['psnr'] for view in applied['views'].values()]):.2f}", f"{target:.3f} ({right:.3f})",
         f"{white:.1f} ({right_white:.1f})", f"{applied['exposure']['gain']:.1f}", "; ".join(said)]
if (scratch / "scores").exists():
    cells.insert(-1, f"{read('scores')['mean']['psnr']:.2f}")
print("|", " | ".join(cells), "|", flush=True)
PYTHON
}

echo "| kind | PSNR, dB | mean (reference) | white, % (reference) | gain |${training:+ trained, dB |} remarks |"
echo "|---|---:|---:|---:|---:|${training:+---:|}---|"
[ $# -gt 0 ] || set -- "${all[@]}"
for kind; do
    set=${SETS:-$scratch/sets}/$kind
    read -r -a with <<< "${options[$kind]---$kind}"
    [ -d "$set" ] || "$NIGHTSPLAT" synth "$set" "${with[@]}" > /dev/null
    "$NIGHTSPLAT" tone apply "$set" --reference "$set/high" --out "$scratch/targets" --json > "$scratch/applied"
    "$NIGHTSPLAT" diagnose "$set" --json > "$scratch/diagnosis"
    if [ -n "$training" ]; then
        "$NIGHTSPLAT" train "$set" --out "$scratch/run" --overwrite --steps "${STEPS:-150}" --progress none > /dev/null
        "$NIGHTSPLAT" eval "$scratch/run" --json > "$scratch/scores"
    fi
    row "$kind" "$set/high" "$scratch"
    rm -r "$scratch/targets"
done
