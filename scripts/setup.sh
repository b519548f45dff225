#!/usr/bin/env bash
# Make .venv with semstab and what it needs, system libraries of Open3D included; `setup.sh dev`: and with what its tests
# and checks need, PyTorch and transformers among it. Quick where there is nothing to do; run it through make.
set -euo pipefail
cd "$(dirname "$0")/.."

declare -A package_of=(
    [libusb-1.0.so.0]=libusb-1.0-0 [libEGL.so.1]=libegl1 [libGL.so.1]=libgl1 [libX11.so.6]=libx11-6
    [libudev.so.1]=libudev1 [libidn2.so.0]=libidn2-0 [libgomp.so.1]=libgomp1
)

stop() { echo "setup: $*" >&2; exit 1; }

install_packages() {
    local as_root=()
    [ "$(id -u)" -eq 0 ] || as_root=(sudo -n)
    local advice="run: sudo apt-get install $*   (then make again)"
    command -v apt-get >/dev/null || stop "missing: $*; install what corresponds to these Debian packages, then make again"
    if [ "$(id -u)" -ne 0 ] && ! sudo -n true 2>/dev/null; then stop "missing system packages and no right to install them; $advice"; fi
    echo "setup: installing $*"
    "${as_root[@]}" apt-get update -qq || stop "apt-get update failed; $advice"
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        stop "apt-get install failed; $advice"
}

python_of_choice() {
    local candidate
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2])' 2>/dev/null; then
            echo "$candidate"
            return
        fi
    done
    stop "needs Python 3.11 or newer, found none; install one, or name it: make PYTHON=/path/to/python"
}

# A system package is looked up by the library file that Open3D loads.
missing=()
libraries=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
for library in "${!package_of[@]}"; do
    [[ $libraries == *"$library "* ]] || missing+=("${package_of[$library]}")
done
[ "$(uname -s)" != Linux ] || [ ${#missing[@]} -eq 0 ] || install_packages "${missing[@]}"

# The report is tested in a browser; where there is none (Ubuntu has it as a snap alone) these tests are left out.
if [ "${1:-}" = dev ] && ! command -v chromium chromium-browser google-chrome >/dev/null; then
    (install_packages chromium) || echo "setup: no chromium: the tests of the report in a browser are left out"
fi

if ! .venv/bin/python -c '' 2>/dev/null; then
    python=$(python_of_choice)
    "$python" -c 'import ensurepip' 2>/dev/null ||
        install_packages "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    rm -rf .venv
    "$python" -m venv .venv
fi

extras=${1:+[$1]}
wanted=$(cat setup.cfg pyproject.toml | sha256sum)
installed=$(cat .venv/semstab-setup 2>/dev/null || true)
if [ "$installed" != "$wanted $extras" ] && [ "$installed" != "$wanted [dev]" ]; then
    echo "setup: installing semstab$extras into .venv"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check -e ".$extras" || stop "pip could not install semstab"
    echo "$wanted $extras" >.venv/semstab-setup
fi

# As pip does for what it copies: Python itself does not where PYTHONDONTWRITEBYTECODE is set, and each start would compile.
.venv/bin/python -m compileall -q benchmark backends models datasets configs conformance
