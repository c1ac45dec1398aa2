#!/usr/bin/env bash
# Night captures: what scenes and cameras at night do to the targets. Prints a Markdown table.
#
#     scripts/night.sh [--train] [KIND...]
#
# A kind is `plain`, or options of `nightsplat synth` joined by +, such as street+sky; without one, those of
# docs/night.md, in about three minutes on two cores. --train adds the PSNR of a training of STEPS (150) steps.
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

# The row of a kind: row KIND REFERENCES SCRATCH.
row() {
    python3 - "$@" << 'PYTHON'
import json, math, pathlib, sys, zlib
kind, references, scratch = sys.argv[1], *map(pathlib.Path, sys.argv[2:])
mean = lambda numbers: sum(numbers) / len(numbers)
read = lambda name: json.loads((scratch / name).read_text())
def rows(png): # of bytes, of an 8-bit RGB image
    chunks, at = {b"IDAT": b""}, 8
    while at < len(png):
        end, name = at + 8 + int.from_bytes(png[at:at + 4], "big"), png[at + 4:at + 8]
        chunks[name], at = chunks.get(name, b"") + png[at + 8:end], end + 4
    raw, stride = zlib.decompress(chunks[b"IDAT"]), 3 * int.from_bytes(chunks[b"IHDR"][:4], "big")
    above = bytes(stride)
    for start in range(0, len(raw), stride + 1):
        kind, row = raw[start], bytearray(raw[start + 1:start + 1 + stride])
        for i in range(stride if kind else 0):
            a, b, c = (row[i - 3], above[i], above[i - 3]) if i > 2 else (0, above[i], 0)
            paeth = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            row[i] = row[i] + (0, a, b, (a + b) // 2, paeth)[kind] & 255
        above = row
        yield row
images = lambda folder: [b"".join(rows(path.read_bytes())) for path in sorted(folder.glob("*.png"))]
def light(images):
    values = b"".join(images)
    planes = zip((0.2126, 0.7152, 0.0722), (values[channel::3] for channel in range(3)))
    return sum(weight * mean(plane) for weight, plane in planes) / 255, 100 * mean([b >= 250 for b in values])
targets, right, found = images(scratch / "targets"), images(references), read("diagnosis")
pairs = zip(b"".join(targets), b"".join(right), strict=True)
psnr = 10 * math.log10(255 ** 2 / mean([(a - b) ** 2 for a, b in pairs]))
(luminance, white), (luminance_right, white_right) = light(targets), light(right)
lines = [line[6:] for line in (scratch / "lines").read_text().splitlines() if line.startswith(" WARN ")]
said = ["curve " + ("on" if found["plan"]["curve"]["on"] else "off"), *dict.fromkeys(lines), *found["remarks"]]
cells = [kind, f"{psnr:.2f}", f"{luminance:.3f} ({luminance_right:.3f})",
         f"{white:.1f} ({white_right:.1f})", f"{read('applied')['exposure']['gain']:.1f}", "; ".join(said)]
trained = [f"{read('scores')['mean']['psnr']:.2f}"] if (scratch / "scores").exists() else []
print("|", " | ".join([*cells[:-1], *trained, cells[-1]]), "|", flush=True)
PYTHON
}

echo "| kind | PSNR, dB | mean (reference) | white, % (reference) | gain |${training:+ trained, dB |} remarks |"
echo "|---|---:|---:|---:|---:|${training:+---:|}---|"
for kind; do
    set=${SETS:-$scratch/sets}/$kind
    read -r -a options <<< "$(sed -E 's/^|\+/ --/g; s/--plain//; s/--street( |$)/--street 3\1/' <<< "$kind")"
    [ -d "$set" ] || "$NIGHTSPLAT" synth "$set" "${options[@]}" > /dev/null
    {
        "$NIGHTSPLAT" tone apply "$set" --out "$scratch/targets" --json > "$scratch/applied"
        "$NIGHTSPLAT" diagnose "$set" --json > "$scratch/diagnosis"
        if [ -n "$training" ]; then
            "$NIGHTSPLAT" train "$set" --out "$scratch/run" --steps "${STEPS:-150}" --overwrite > /dev/null
            "$NIGHTSPLAT" eval "$scratch/run" --json > "$scratch/scores"
        fi
    } 2> "$scratch/lines"
    row "$kind" "$set/high" "$scratch"
    rm -r "$scratch/targets"
done
