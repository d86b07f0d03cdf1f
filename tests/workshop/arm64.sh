#!/usr/bin/env bash
# Runs the package on an arm64 Python under qemu-user, for a release: `tests/workshop/arm64.sh FOLDER`.
# Needs Debian 12 with qemu-user, pip, and the network: packages and wheels are kept in FOLDER.
# QEMU_CPU=neoverse-n1 has no SME; qemu's own choice has it, and OpenBLAS then takes other kernels.
# Tests that start processes are left out: under qemu-user no process can start another Python.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
checkout=$PWD
mkdir -p "$1"/{lists/partial,cache/archives/partial,packages,root,wheels,site}
cd "$1"
room=$PWD
touch status
cat > apt.conf <<END
APT::Architecture "arm64";
APT::Architectures {"arm64";};
Dir::State::lists "$room/lists";
Dir::State::status "$room/status";
Dir::Cache "$room/cache";
END
if [ ! -e root/usr/bin/python3.11 ]; then
    export APT_CONFIG="$room"/apt.conf
    apt-get update
    (
        cd packages
        apt-get download libc6 libgcc-s1 libstdc++6 zlib1g libexpat1 libssl3 libffi8 libbz2-1.0 liblzma5 \
            libsqlite3-0 libuuid1 libcrypt1 {libpython3.11,python3.11}-minimal libpython3.11-stdlib
    )
    for package in packages/*.deb; do dpkg-deb -x "$package" root; done
    unset APT_CONFIG
    platforms=$(printf -- '--platform manylinux_2_%s_aarch64 ' 17 24 26 27 28)
    python3 -m pip download $platforms --only-binary=:all: --python-version 3.11 -d wheels \
        numpy scipy imageio matplotlib pytest
    for wheel in wheels/*.whl; do python3 -m zipfile -e "$wheel" site; done
fi
python() {
    env PYTHONPATH="$room/site:$checkout" PYTHONDONTWRITEBYTECODE=1 \
        qemu-aarch64 -L "$room"/root "$room"/root/usr/bin/python3.11 -W error "$@"
}
for processor in ${QEMU_CPU:-neoverse-n1 max}; do
    export QEMU_CPU=$processor
    echo "--- $processor"
    python -m p4dgs_ref --version
    (cd "$room" && rm -rf report && python -m p4dgs_ref demo --preset smoke)
    (cd "$room" && python -m p4dgs_ref stability -o map --only H-R1)
    (cd "$checkout" && python -m pytest -p no:cacheprovider tests/equations tests/codec \
        tests/oracle/test_published.py tests/oracle/test_vectors.py tests/oracle/test_streams.py)
done
