#!/bin/sh
# Fill a folder with the files of an arm64 computer: Debian's kernel, its programs that the tests use, and the packages of
# the project: arm64.sh FOLDER. Nothing is installed or run, so it works on any Debian computer, as root. It takes a minute.
set -eu
folder=$1
cd "$(dirname "$0")/../../.."
uv=$(command -v uv || echo .tools/bin/uv)
mkdir -p "$folder"

programs=base-files,base-passwd,bash,busybox-static,coreutils,dash,debianutils,findutils,grep,hostname,kmod,libc-bin,libstdc++6
programs=$programs,login,mawk,mount,procps,psmisc,python3,sed,sudo,udev,util-linux
mmdebstrap --quiet --variant=extract --architectures=arm64 --hook-dir=/usr/share/mmdebstrap/hooks/merged-usr \
    --include="$programs,linux-image-arm64" bookworm "$folder"
for name in passwd group; do
    cp "$folder/usr/share/base-passwd/$name.master" "$folder/etc/$name"
done
ln -sf mawk "$folder/usr/bin/awk"
for release in "$folder"/lib/modules/*; do
    depmod -b "$folder" "$(basename "$release")"
done

# There is no binary of cobs for arm64. It also works without its compiled part.
packages="$folder/usr/local/lib/python3.11/dist-packages"
awk '/^[a-z]/ { other = !/^cobs==/ } other' requirements.lock > "$folder/tmp/requirements.lock"
"$uv" pip install --quiet --python .venv/bin/python --target "$packages" --python-platform aarch64-manylinux_2_28 \
    --python-version 3.11 --only-binary :all: --no-deps --require-hashes -r "$folder/tmp/requirements.lock"
"$uv" pip install --quiet --python .venv/bin/python --target "$packages" --no-deps --no-build-isolation \
    "$(grep -o '^cobs==[0-9.]*' requirements.lock)" --editable .
.venv/bin/python -m compileall -q -j 0 -s "$folder" -p / "$folder/usr/lib/python3.11" "$packages"
