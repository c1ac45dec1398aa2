#!/usr/bin/env bash
# Runs every command of README.md's `sh` blocks, in order, in a copy of this checkout; `cargo install` goes first. A
# command to skip is named in a comment of the README, `<!-- follow: ... -->`, and printed as `not run`.
#
#     scripts/follow-readme.sh [NIGHTSPLAT]      with a program, nothing is installed, and a shorter demo runs with it
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
program=${1:+$(realpath "$1")}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
git ls-files -z --cached --others --exclude-standard | xargs -0 -I {} sh -c '[ -e "$1" ] && echo "$1"' sh {} |
    tar -c -T - | tar -x -C "$scratch"
cd "$scratch"

# Installs into the copy, with the dependencies that are already built.
export CARGO_INSTALL_ROOT=$scratch/installed CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target}
export PATH=$scratch/installed/bin:$PATH
if [ -n "$program" ]; then
    mkdir -p installed/bin
    ln -s "$program" installed/bin/nightsplat
fi
# This profile builds in half of the time, and runs a little slower than the user's.
export CARGO_PROFILE_RELEASE_OPT_LEVEL=1 CARGO_PROFILE_RELEASE_LTO=off CARGO_PROFILE_RELEASE_INCREMENTAL=false

has() { command -v "$1" > /dev/null; }

# The user's photographs: dark, without cameras, and small, to save time.
photograph() {
    nightsplat synth taken --views 16 --width 192 --height 144 > /dev/null
    mkdir phone
    cp taken/low/* phone/
}

follow() {
    case ${program:+with }$1 in
    "with cargo install"*) return ;;
    "with make demo"*) set -- "nightsplat demo --out demo --steps 60" ;;
    esac
    case $1 in
    "make test"* | podman*)
        "$root/scripts/not-run.sh" readme "$1"
        return
        ;;
    "nightsplat phone")
        photograph
        if ! has colmap; then
            "$root/scripts/not-run.sh" colmap "$1"
            rm -r phone
            mv taken phone
        fi
        # As far as it can go in the time of a check.
        set -- "$1 --steps 60"
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

mapfile -t commands < <(sed -n '/^```sh$/,/^```$/{/^```/!p}' README.md | sed 's/ *#.*//' | grep .)
install=$(printf '%s\n' "${commands[@]}" | grep '^cargo install')
follow "$install"
for command in "${commands[@]}"; do
    [ "$command" = "$install" ] || follow "$command"
done

[ "${#commands[@]}" -ge 6 ]
for file in demo/index.html phone-splat/phone.html; do
    [ -s "$file" ] || { echo "failed: $file was not written"; exit 1; }
done
echo "the ${#commands[@]} commands of the README work, in $SECONDS s"
