#!/usr/bin/env bash
# Follows README.md word by word, in a copy of this checkout: every line of its `sh` blocks, in order. What is left out is
# said in a comment of the README's, `<!-- follow: ... -->` before the block, and here, by name.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
git ls-files -z --cached --others --exclude-standard | xargs -0 -I {} sh -c '[ -e "$1" ] && echo "$1"' sh {} |
    tar -c -T - | tar -x -C "$scratch"
cd "$scratch"

# Installed in the copy, built from the dependencies that are built already.
export CARGO_INSTALL_ROOT=$scratch/installed CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target}
export PATH=$scratch/installed/bin:$PATH
# Built to be tried: in half of the time, and a bit slower than what a user gets.
export CARGO_PROFILE_RELEASE_OPT_LEVEL=1 CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_INCREMENTAL=false

has() { command -v "$1" > /dev/null; }

# The user's photographs: dark, without cameras, and small, as nobody waits here.
photograph() {
    nightsplat synth taken --views 16 --width 192 --height 144 > /dev/null
    mkdir phone
    cp taken/low/* phone/
}

follow() {
    case $1 in
    "make test"* | podman*)
        echo "not run: $1"
        return
        ;;
    "nightsplat pose "*)
        [ -e phone ] || photograph
        if ! has colmap; then
            echo "not run: $1 (there is no colmap)"
            cp -r taken photos
            return
        fi
        ;;
    *"--video"*)
        if ! has ffmpeg; then
            echo "not run: $1 (there is no ffmpeg)"
            return
        fi
        ;;
    esac
    echo "\$ $1"
    local began=$SECONDS
    bash -eo pipefail -c "$1" > output.log 2>&1 || {
        cat output.log
        echo "failed: $1"
        exit 1
    }
    echo "  $((SECONDS - began)) s"
}

count=0
while IFS= read -r line <&3; do
    line=$(sed 's/ *#.*//' <<< "$line")
    [ -n "$line" ] || continue
    follow "$line"
    count=$((count + 1))
done 3< <(sed -n '/^```sh$/,/^```$/{/^```/!p}' README.md)

[ "$count" -ge 10 ]
for file in demo/index.html run/model.html run/model.ply man1/nightsplat.1 nightsplat.bash; do
    [ -s "$file" ] || { echo "failed: $file was not written"; exit 1; }
done
echo "the README's $count commands do what it says, in $SECONDS s"
