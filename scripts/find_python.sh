#!/bin/sh
# Print a Python that can create the virtual environment, or one line about what is missing.
# 3.11 is tried first, because the pinned versions are tested with it. PYTHON overrides the choice.
set -u

can_run() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1
}

for candidate in ${PYTHON:-python3.11 python3 python3.12 python3.13 python3.14}; do
    can_run "$candidate" || continue
    if ! "$candidate" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        echo "$candidate cannot make virtual environments: install its venv package (Debian: apt-get install python3-venv)" >&2
        exit 1
    fi
    echo "$candidate"
    exit 0
done
echo "Python 3.11 or newer is needed, found: $(${PYTHON:-python3} --version 2>&1 | head -n 1) (set PYTHON=/path/to/python3.11)" >&2
exit 1
