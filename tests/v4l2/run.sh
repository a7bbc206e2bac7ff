#!/usr/bin/env bash
# Boots Debian's kernel with its virtual camera (vivid) under QEMU's software emulation and runs our programs in it,
# on a real V4L2 device. Usage: run.sh GUEST_BINARY OAPWATCH_BINARY [SCENARIO...]. What it fetches and makes is kept
# under target/v4l2 for the next run. MEMORY_MB is the machine's memory: a sanitizer wants more.
# Needs: qemu-system-x86 busybox-static kmod cpio v4l-utils xz-utils, and a Debian package source for the kernel.
set -euo pipefail
cd "$(dirname "$0")/../.."
work=$PWD/target/v4l2
guest=$1
program=$2
shift 2
mkdir -p "$work"

for tool in qemu-system-x86_64 busybox depmod cpio v4l2-ctl xz apt-get dpkg-deb; do
    if ! command -v "$tool" > /dev/null; then
        echo "tests/v4l2: $tool is missing: apt-get install qemu-system-x86 busybox-static kmod cpio v4l-utils xz-utils"
        exit 1
    fi
done

if [ ! -d "$work/kernel" ]; then
    echo "Fetching Debian's kernel"
    package=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: //p' | head -n 1)
    rm -rf "$work/kernel.part" "$work"/linux-image-*.deb
    (cd "$work" && apt-get download -q "$package" 2> /dev/null)
    mkdir -p "$work/kernel.part"
    dpkg-deb --extract "$work"/linux-image-*.deb "$work/kernel.part"
    rm "$work"/linux-image-*.deb
    depmod -b "$work/kernel.part" "$(ls "$work/kernel.part/lib/modules")"
    mv "$work/kernel.part" "$work/kernel"
fi
version=$(ls "$work/kernel/lib/modules")

# QEMU boots the unpacked kernel directly, which saves the guest from unpacking it under emulation.
if [ ! -f "$work/vmlinux" ]; then
    vmlinuz=$work/kernel/boot/vmlinuz-$version
    offset=$(grep -abo $'\xfd7zXZ' "$vmlinuz" | head -n 1 | cut -d: -f1 || true)
    [ -n "$offset" ] || { echo "tests/v4l2: no xz stream in $vmlinuz"; exit 1; }
    # The stream is followed by other data, at which xz complains after having unpacked everything.
    tail -c "+$((offset + 1))" "$vmlinuz" | xz -dc --single-stream > "$work/vmlinux.part" 2> /dev/null || true
    mv "$work/vmlinux.part" "$work/vmlinux"
fi

root=$work/root
rm -rf "$root"
mkdir -p "$root"/{bin,dev,proc,sys,tmp,modules,lib64}
cp "$(command -v busybox)" "$root/bin/busybox"
n=10
for module in $(modprobe -d "$work/kernel" -S "$version" --show-depends vivid | sed -n 's/^insmod \([^ ]*\).*/\1/p'); do
    cp "$module" "$root/modules/$n-$(basename "$module")"
    n=$((n + 1))
done
# A program with the libraries it is linked to, wherever they are.
install_program() {
    install -D -m 755 "$1" "$root/bin/$2"
    strip --strip-debug "$root/bin/$2" 2> /dev/null || true
    { ldd "$1" 2> /dev/null || true; } | { grep -o '/[^ )]*' || true; } | while read -r library; do
        [ -e "$root$library" ] || install -D -m 755 "$(readlink -f "$library")" "$root$library"
    done
}
install_program "$(command -v v4l2-ctl)" v4l2-ctl
install_program "$guest" guest
install_program "$program" oapwatch
install -m 755 tests/v4l2/init.sh "$root/init"
echo "$*" > "$root/scenarios"
(cd "$root" && find . | cpio --quiet -o -H newc | gzip -1) > "$work/initramfs.gz"

# isa-debug-exit turns a value written to its port into QEMU's exit code, (value << 1) | 1.
set +e
timeout 300 qemu-system-x86_64 -accel tcg -cpu qemu64 -smp 1 -m "${MEMORY_MB:-512}" -nodefaults -no-user-config -display none \
    -serial stdio -monitor none -no-reboot -icount shift=auto,sleep=off \
    -device isa-debug-exit,iobase=0xf4,iosize=0x04 \
    -kernel "$work/vmlinux" -initrd "$work/initramfs.gz" \
    -append "console=ttyS0 quiet loglevel=2 panic=-1 nokaslr mitigations=off tsc=reliable no_timer_check random.trust_cpu=on cryptomgr.notests" \
    < /dev/null
code=$?
set -e
case $code in
    1) echo "tests/v4l2: all scenarios passed" ;;
    124) echo "tests/v4l2: the machine did not come to an end in 300 s"; exit 1 ;;
    *) echo "tests/v4l2: failed (QEMU ended with $code)"; exit 1 ;;
esac
