#!/bin/sh
# Build an environment for kapture-localization 1.1.10 in folder $1: its packages in a virtual
# environment, and a COLMAP 3 binary from the system's packages.
set -eu
venv=${1:?usage: kloc_env.sh FOLDER}
here=$(dirname "$0")

if ! command -v colmap >/dev/null 2>&1; then
    if ! command -v apt-get >/dev/null 2>&1 || [ "$(id -u)" != 0 ]; then
        echo "COLMAP 3 is needed (Debian, Ubuntu: sudo apt-get install colmap); then run this again" >&2
        exit 1
    fi
    echo "Installing COLMAP from the system's packages."
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends colmap >/dev/null
fi
version=$(QT_QPA_PLATFORM=offscreen colmap -h 2>/dev/null | sed -n 's/^COLMAP \([0-9.]*\).*/\1/p')
case $version in
    3.*) ;;
    *)
        echo "COLMAP 3 is needed, this is '$version': kapture-localization passes options that later ones renamed" >&2
        exit 1
        ;;
esac

python=$(sh "$here/../../scripts/find_python.sh")
test -x "$venv/bin/python" || "$python" -m venv "$venv"
echo "Installing kapture-localization into $venv."
"$venv/bin/python" -m pip install -qq --disable-pip-version-check \
    -r "$here/kloc_requirements.txt"
# its own requirements name opencv-python (with windows) and cvxpy; none of the tools here needs them
"$venv/bin/python" -m pip install -qq --disable-pip-version-check --no-deps \
    kapture-localization==1.1.10
"$venv/bin/python" -c 'import kapture_localization, kapture, pycolmap, torch, cv2' ||
    { echo "the environment in $venv does not import; delete it and run this again" >&2; exit 1; }
echo "COLMAP $version and $venv are ready: make bench KLOC_PYTHON=$venv/bin/python"
