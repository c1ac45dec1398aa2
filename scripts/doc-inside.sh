#!/usr/bin/env bash
# Documents every crate with the modules that are no API, for who works on them; a broken link fails. Options go to
# `cargo doc`: scripts/doc-inside.sh --open
set -euo pipefail
cd "$(dirname "$0")/.."

# Rustdoc shows what is hidden only as an unstable option. Set for cargo, the variable would compile dependencies again.
folder=$(realpath -m "${CARGO_TARGET_DIR:-target}")
mkdir -p "$folder"
rustdoc=$folder/rustdoc-inside
cat > "$rustdoc" << 'END'
#!/bin/sh
RUSTC_BOOTSTRAP=1 exec rustdoc -Z unstable-options --document-hidden-items "$@"
END
chmod +x "$rustdoc"
RUSTDOC=$rustdoc RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps "$@"
