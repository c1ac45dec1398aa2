#!/usr/bin/env bash
# Packs a built program for those who do not build it: scripts/package.sh TARGET BINARY
# leaves dist/nightsplat-VERSION-TARGET.tar.gz (.zip for Windows) with completions, man pages and licences, and its checksum.
# GLIBC names the newest glibc that it may need; without it that is said, and all.
set -euo pipefail
cd "$(dirname "$0")/.."
target=${1:?name the target, such as x86_64-unknown-linux-gnu}
binary=${2:?name the program that was built}

version=$("$binary" --version | cut -d ' ' -f 2)
name=nightsplat-$version-$target
rm -rf "dist/$name"
mkdir -p "dist/$name/completions"
cp "$binary" README.md CHANGELOG.md LICENSE-APACHE LICENSE-MIT "dist/$name/"
"$binary" man "dist/$name/man/man1"
for shell in bash elvish fish powershell zsh; do
    "$binary" completions "$shell" > "dist/$name/completions/nightsplat.$shell"
done

# What an old distribution has to bring: 2.17 is of 2012.
case $target in
*-linux-gnu)
    newest=$(objdump -T "$binary" | grep -o 'GLIBC_[0-9.]*' | sort -Vu | tail -1)
    echo "$name needs $newest"
    most=GLIBC_${GLIBC:-${newest#GLIBC_}}
    if [ "$(printf '%s\n' "$newest" "$most" | sort -V | tail -1)" != "$most" ]; then
        echo "$name must not need more than $most" >&2
        exit 1
    fi
    ;;
esac

cd dist
case $target in
*-windows-*)
    archive=$name.zip
    7z a -bso0 "$archive" "$name"
    ;;
*)
    archive=$name.tar.gz
    tar -czf "$archive" "$name"
    ;;
esac
if command -v sha256sum > /dev/null; then sha256sum "$archive"; else shasum -a 256 "$archive"; fi > "$archive.sha256"
cat "$archive.sha256"
