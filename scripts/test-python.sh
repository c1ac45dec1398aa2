#!/usr/bin/env bash
# Builds the Python package, and tests it: the wheel is installed into a clean environment, where the example runs; its
# types are checked against the module; and its tests compare it with the command, under the validation layer.
#     scripts/test-python.sh [NIGHTSPLAT]      (default: target/debug/nightsplat, whose build is done)
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD

python=${PYTHON:-python3}
"$python" -c 'import sys, venv, ensurepip; assert sys.version_info >= (3, 9)' 2> /dev/null ||
    exec scripts/not-run.sh python 'there is no Python 3.9 or later with venv'
export CARGO_TARGET_DIR=${CARGO_TARGET_DIR:-$root/target}
command=$(realpath "${1:-$CARGO_TARGET_DIR/debug/nightsplat}")
# The kernels that were compiled for the command: the build of the package needs no other compiler.
kernels=$(dirname "$(ls -t "$CARGO_TARGET_DIR"/debug/build/nightsplat-*/out/sources.hash | head -1)")
folder=$(mktemp -d)
trap 'rm -rf "$folder" "$root/precompiled"' EXIT
rm -rf precompiled
mkdir precompiled
cp "$kernels"/*.spv "$kernels/kernels.rs" "$kernels/sources.hash" precompiled/

cargo fmt --check --manifest-path crates/python/Cargo.toml
"$python" -m venv "$folder/tools"
"$folder/tools/bin/pip" install --quiet maturin==1.16.0 mypy==2.4.1 numpy pytest==9.2.0
"$folder/tools/bin/maturin" build --quiet --locked --strip --profile dev --no-default-features --out "$folder/wheel" \
    --manifest-path crates/python/Cargo.toml --interpreter "$folder/tools/bin/python"
ls -l "$folder"/wheel/*.whl

# A clean environment, out of the reach of the sources.
"$python" -m venv "$folder/clean"
"$folder/clean/bin/pip" install --quiet "$folder"/wheel/*.whl
(cd "$folder" && clean/bin/python "$root/examples/python/first.py")

"$folder/tools/bin/pip" install --quiet "$folder"/wheel/*.whl
cd crates/python
"$folder/tools/bin/mypy" --cache-dir "$folder/mypy" --strict python/nightsplat ../../examples/python
"$folder/tools/bin/stubtest" nightsplat
NIGHTSPLAT=$command "$folder/tools/bin/python" -m pytest -q -p no:cacheprovider tests
