#!/bin/sh
# Fill a folder with the files of another computer: Debian's kernel, its programs that the tests use, and the packages of
# the project: computer.sh KIND FOLDER. KIND is arm64, or picamera2: Debian 13 with libcamera and picamera2.
# Nothing is installed on this computer, so it works on any Debian computer, as root. It takes a minute.
set -eu
kind=$1 folder=$2
case $kind in
    arm64) architecture=arm64 debian=bookworm python=3.11 platform=aarch64-manylinux_2_28 more= ;;
    picamera2)
        architecture=amd64 debian=trixie python=3.13 platform=x86_64-manylinux_2_40
        more=,libpam-modules,python3-libcamera,python3-piexif,python3-pil,python3-prctl ;;
esac
cd "$(dirname "$0")/../../.."
uv=$(command -v uv || echo .tools/bin/uv)
mkdir -p "$folder"

programs=base-files,base-passwd,bash,busybox-static,coreutils,dash,debianutils,findutils,grep,hostname,kmod,libc-bin,libstdc++6
programs=$programs,login,mawk,mount,procps,psmisc,python3,sed,sudo,udev,util-linux
mmdebstrap --quiet --variant=extract --architectures=$architecture --hook-dir=/usr/share/mmdebstrap/hooks/merged-usr \
    --include="$programs,linux-image-$architecture$more" $debian "$folder"
for name in passwd group; do
    cp "$folder/usr/share/base-passwd/$name.master" "$folder/etc/$name"
done
ln -sf mawk "$folder/usr/bin/awk"
for release in "$folder"/lib/modules/*; do
    depmod -b "$folder" "$(basename "$release")"
done

# Without a binary for the computer, cobs also works without its compiled part. No test needs reuse in the machine.
packages="$folder/usr/local/lib/python$python/dist-packages"
binaries() {
    "$uv" pip install --quiet --python .venv/bin/python --target "$packages" --python-platform $platform \
        --python-version $python --only-binary :all: --no-deps "$@"
}
awk '/^[a-z]/ { other = !/^(cobs|reuse)==/ } other' requirements.lock > "$folder/tmp/requirements.lock"
binaries --require-hashes -r "$folder/tmp/requirements.lock"
"$uv" pip install --quiet --python .venv/bin/python --target "$packages" --no-deps --no-build-isolation \
    "$(grep -o '^cobs==[0-9.]*' requirements.lock)" --editable .

if [ "$kind" = picamera2 ]; then
    # Later versions of picamera2 need a later libcamera than Debian has. The modules that it imports to draw on a screen
    # (pykms) and to write raw images (pidng) are not packaged; nothing of them is used.
    binaries picamera2==0.3.25 v4l2-python3==0.3.5 simplejpeg==1.9.0 av==19.0.2
    mkdir -p "$packages/pidng"
    touch "$packages/pidng/__init__.py"
    echo "Picamera2Camera = None" > "$packages/pidng/camdefs.py"
    echo "PICAM2DNG = None" > "$packages/pidng/core.py"
    printf 'from unittest.mock import MagicMock\n\nPixelFormat = MagicMock()\n' > "$packages/pykms.py"
    chroot "$folder" python3 -m compileall -q -j 0 "/usr/lib/python$python" /usr/lib/python3 "${packages#"$folder"}"
else
    .venv/bin/python -m compileall -q -j 0 -s "$folder" -p / "$folder/usr/lib/python$python" "$packages"
fi
