#!/usr/bin/env bash
# Makes the pictures of docs/gallery.md anew, by the commands on that page: a dark test photograph beside the model from
# its camera, docs/gallery/SCENE.jpg.
#
#     scripts/gallery.sh [SCENE...]
#
# SCENE         those that are made (default: every one of the page)
# NIGHTSPLAT    the command (default: target/release/nightsplat, built first)
# SETS          the folder to work in, which is kept (default: a temporary folder)
set -euo pipefail
cd "$(dirname "$0")/.."
command -v ffmpeg > /dev/null || exec scripts/not-run.sh ffmpeg 'it joins the halves of a picture, and is not installed'
root=$PWD
if [ -z "${NIGHTSPLAT:-}" ]; then
    cargo build --quiet --release --bin nightsplat
    NIGHTSPLAT=${CARGO_TARGET_DIR:-target}/release/nightsplat
fi
program=$(realpath "$NIGHTSPLAT")
work=${SETS:-$(mktemp -d)}
[ -n "${SETS:-}" ] || trap 'rm -rf "$work"' EXIT
mkdir -p "$work"
cd "$work"
nightsplat() { "$program" "$@"; }
export NIGHTSPLAT_TUNE=off # the built-in tiles
# The test view of each picture.
view=008

mapfile -t commands < <(sed -n '/^```sh$/,/^```$/{/^```/d;p}' "$root/docs/gallery.md")
for command in "${commands[@]}"; do
    read -r -a words <<< "$command"
    scene=${words[2]%%-run}
    [ $# -eq 0 ] || [[ " $* " == *" $scene "* ]] || continue
    echo "$command"
    nightsplat "${words[@]:1}" > "$scene.log" 2>&1 || { cat "$scene.log" >&2 && exit 1; }
    [ "${words[1]}" = render ] || continue
    ffmpeg -v error -y -i "$scene/low/$view.png" -i "$scene-lit/$view.png" -filter_complex hstack -q:v 3 -bitexact \
        "$root/docs/gallery/$scene.jpg"
done
