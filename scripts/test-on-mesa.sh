#!/usr/bin/env bash
# Runs every test on the software device of another Debian suite, in a chroot under target/, and prints that device:
#     scripts/test-on-mesa.sh sid
# Newer versions of Mesa support more, such as cooperative matrices, and newer validation layers check more. Needs root
# and debootstrap.
set -euo pipefail
cd "$(dirname "$0")/.."
suite=${1:?name a Debian suite, such as sid}
root=$PWD/target/mesa/$suite

packages=mesa-vulkan-drivers,vulkan-validationlayers
if [ ! -e "$root/usr/share/vulkan" ]; then
    rm -rf "$root"
    debootstrap --variant=minbase --include=$packages "$suite" "$root" > /dev/null
fi
cargo build
tests=$(cargo test --no-run --message-format=json-render-diagnostics |
    sed -n '/"profile":{[^}]*"test":true}/s|.*"executable":"\([^"]*\)".*|\1|p')

mkdir -p "$root$PWD" "$root/proc"
trap 'umount "$root$PWD" "$root/proc"' EXIT
mount --bind "$PWD" "$root$PWD"
mount --bind /proc "$root/proc"
inside() { chroot "$root" env HOME=/root bash -c "cd '$PWD' && \"\$@\"" bash "$@"; }

inside target/debug/nightsplat doctor
failed=()
for test in $tests; do
    inside "$test" || failed+=("$test")
done
scripts/record-driver.sh chroot "$root" env HOME=/root bash -c "cd '$PWD' && \"\$@\"" bash || failed+=(bench)
if [ ${#failed[@]} -gt 0 ]; then
    printf 'failed on %s: %s\n' "$suite" "${failed[@]}"
    exit 1
fi
echo "every test passes on $suite"
