#!/usr/bin/env bash
# Speed by commit: counts the instructions of five paths of the host by callgrind, beyond those of `nightsplat
# --version`, and compares them with the last ones in docs/instructions.csv. A count, unlike a time, does not depend on
# what else the machine does. Fails where one differs by more than 2 %: a slower path is a defect, and a faster one is
# recorded. Those of another compiler are only printed, until they are recorded.
#
#     scripts/instructions.sh [--record] [NIGHTSPLAT]
#
#   --record     appends this commit's counts to docs/instructions.csv instead
#   NIGHTSPLAT   the command, of the dev profile, as counts are recorded (default: target/debug/nightsplat, built first)
set -euo pipefail
cd "$(dirname "$0")/.."
record=
[ "${1:-}" != --record ] || { record=1 && shift; }
command -v valgrind > /dev/null || exec scripts/not-run.sh valgrind 'it is not installed'
if [ $# -eq 0 ]; then
    cargo build --quiet --bin nightsplat
    set -- "${CARGO_TARGET_DIR:-target}/debug/nightsplat"
fi
nightsplat=$(realpath "$1")
table=$PWD/docs/instructions.csv
commit=$(git rev-parse --short=8 HEAD)
compiler=$(rustc --version | cut -d' ' -f2)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cd "$scratch"
export RAYON_NUM_THREADS=1

# Two thousand Gaussians of degree 3, as 3DGS writes them.
python3 - << 'PYTHON'
import random, struct
names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)),
         "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
draw = random.Random(1)
with open("model.ply", "wb") as file:
    file.write(b"ply\nformat binary_little_endian 1.0\nelement vertex 2000\n")
    file.write("".join(f"property float {name}\n" for name in names).encode() + b"end_header\n")
    for _ in range(2000):
        file.write(struct.pack(f"<{len(names)}f", *(draw.gauss(0, 1) for _ in names)))
PYTHON
"$nightsplat" synth pairs --views 8 --width 96 --height 72 > out 2>&1
"$nightsplat" export model.ply --format spz --out model.spz > out 2>&1

# The instructions of a command.
count() {
    valgrind --tool=callgrind --callgrind-out-file=callgrind.out "$nightsplat" "$@" > out 2> counted ||
        { cat out counted >&2 && return 1; }
    sed -n 's/^.*Collected : \([0-9]*\).*$/\1/p' counted
}

base=$(count --version)
failed=0
# path NAME ARGUMENT...
path() {
    local name=$1 now
    shift
    now=$(count "$@")
    now=$((now - base))
    if [ -n "$record" ]; then
        echo "$commit,$compiler,$name,$now" | tee -a "$table"
        return
    fi
    awk -F, -v name="$name" -v now="$now" -v compiler="$compiler" '
        $3 == name { recorded = $2; before = $4 }
        END {
            change = before > 0 ? 100 * (now / before - 1) : 100
            printf "%-24s %12d instructions, %+.1f %%", name, now, change
            is_same = recorded == "" || recorded == compiler
            print (is_same ? "" : " since rustc " recorded)
            exit (is_same && (change > 2 || change < -2))
        }' "$table" || failed=1
}
path "synthetic set" synth again --views 2 --width 96 --height 72
path "decoding and curve fit" tone fit pairs
path "PLY to SPZ" export model.ply --format spz --out a.spz
path "SPZ to PLY" export model.spz --format ply --out a.ply
path "PLY to SOG" export model.ply --format sog --out a.sog
if [ "$failed" -ne 0 ]; then
    echo "a path has other counts than docs/instructions.csv: find the reason, or scripts/instructions.sh --record" >&2
    exit 1
fi
