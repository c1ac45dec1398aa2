#!/usr/bin/env bash
# The pictures of the README, from nothing: a synthetic room at 640x480, a training on it, before and after, a flight.
#
#     scripts/readme-pictures.sh [NIGHTSPLAT]      (default: target/release/nightsplat)
#
# Writes docs/night.jpg and docs/flight.webp, in about five minutes on two cores. Needs ffmpeg with libwebp.
set -euo pipefail
cd "$(dirname "$0")/.."
nightsplat=${1:-target/release/nightsplat}
if ! ffmpeg -hide_banner -encoders 2> /dev/null | grep -q ' libwebp '; then
    exec scripts/not-run.sh ffmpeg "the pictures of the README: there is no ffmpeg with libwebp (apt install ffmpeg)"
fi
steps=${STEPS:-700} frames=${FRAMES:-36} # of the training, and of the flight
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
"$nightsplat" synth "$scratch/room" --width 640 --height 480
"$nightsplat" train "$scratch/room" --out "$scratch/run" --steps "$steps"
"$nightsplat" render "$scratch/run" --split test --out "$scratch/renders"
"$nightsplat" render "$scratch/run" --path auto --frames "$frames" --out "$scratch/flight"
# The first test view, as photographed and as rendered.
before=$scratch/room/low/000.png after=$scratch/renders/000.png
ffmpeg -loglevel error -y -i "$before" -i "$after" \
    -filter_complex '[0]pad=iw+8:ih:0:0:white[before];[before][1]hstack' -q:v 4 docs/night.jpg
# Files of the repository stay small. Every frame is whole: parts of frames, as libwebp_anim writes, leave blocks.
ffmpeg -loglevel error -y -framerate 8 -pattern_type glob -i "$scratch/flight/*.png" \
    -c:v libwebp -preset picture -compression_level 6 -q:v 25 -loop 0 docs/flight.webp
ls -l docs/night.jpg docs/flight.webp
