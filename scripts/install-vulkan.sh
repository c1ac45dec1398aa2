#!/usr/bin/env bash
# Checks the requirements of building and testing: cargo, a C++ compiler, the Vulkan loader, a Vulkan device and the
# validation layer. Installs the missing parts of Vulkan on Debian and Ubuntu; elsewhere prints what to install.
set -euo pipefail

fail() {
    printf '%s\n' "$@" >&2
    exit 1
}

# True if a folder of Vulkan's manifests contains one that matches the pattern.
has_manifest() {
    local folder
    for folder in /usr/share/vulkan /usr/local/share/vulkan /etc/vulkan \
        "${XDG_DATA_HOME:-${HOME:-}/.local/share}/vulkan" ${VULKAN_SDK:+"$VULKAN_SDK/share/vulkan"}; do
        compgen -G "$folder/$1" > /dev/null && return 0
    done
    return 1
}

has_loader() {
    # ldconfig is not on the path of every user.
    grep -qs 'libvulkan\.so\.1' <<< "$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p 2> /dev/null)" ||
        { [ -n "${VULKAN_SDK:-}" ] && [ -e "$VULKAN_SDK/lib/libvulkan.so.1" ]; }
}

has_device() {
    [ -n "${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}" ] || has_manifest 'icd.d/*.json'
}

has_validation() {
    # The Vulkan SDK's layers are found where VK_LAYER_PATH points.
    has_manifest 'explicit_layer.d/VkLayer_khronos_validation.json' ||
        { [ -n "${VK_LAYER_PATH:-}" ] && [ -e "$VK_LAYER_PATH/VkLayer_khronos_validation.json" ]; }
}

command -v cargo > /dev/null ||
    fail 'cargo is missing: install Rust 1.89 or newer from https://rustup.rs'
command -v "${CXX:-c++}" > /dev/null ||
    fail 'a C++ compiler is missing: on Debian and Ubuntu `apt install g++`, on Fedora `dnf install gcc-c++`,' \
        'on Arch `pacman -S gcc`, on macOS `xcode-select --install`'

if [ "$(uname -s)" != Linux ]; then
    # The path of the loader differs by system; `nightsplat doctor` finds it.
    [ -n "${VULKAN_SDK:-}" ] || cat >&2 <<'NOTE'
note: Vulkan 1.3 and its validation layer come with the Vulkan SDK (https://vulkan.lunarg.com);
      on macOS also `brew install vulkan-loader vulkan-validationlayers molten-vk`
NOTE
    exit 0
fi

missing=()
has_loader || missing+=(libvulkan1)
has_device || missing+=(mesa-vulkan-drivers)
has_validation || missing+=(vulkan-validationlayers)
[ ${#missing[@]} -eq 0 ] && exit 0

if command -v apt-get > /dev/null; then
    as_root=()
    if [ "$(id -u)" -ne 0 ]; then
        command -v sudo > /dev/null || fail "as root: apt-get install ${missing[*]}"
        as_root=(sudo)
    fi
    echo "installing ${missing[*]}" >&2
    "${as_root[@]}" apt-get update -qq
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive \
        apt-get install -y -qq --no-install-recommends "${missing[@]}" >&2
    exit 0
fi

fail "missing, by their names on Debian: ${missing[*]}" \
    '  Fedora    dnf install vulkan-loader mesa-vulkan-drivers vulkan-validation-layers' \
    '  Arch      pacman -S vulkan-icd-loader vulkan-swrast vulkan-validation-layers' \
    '  openSUSE  zypper install libvulkan1 libvulkan_lvp vulkan-validationlayers' \
    '  else      a Vulkan 1.3 driver, its loader, and VK_LAYER_KHRONOS_validation'
