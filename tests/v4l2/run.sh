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

. tests/machine/kernel.sh

root=$work/root
rm -rf "$root"
mkdir -p "$root"/{bin,dev,proc,sys,tmp,lib64}
cp "$(command -v busybox)" "$root/bin/busybox"
install_modules "$root" vivid
install_program "$(command -v v4l2-ctl)" v4l2-ctl "$root"
install_program "$guest" guest "$root"
install_program "$program" oapwatch "$root"
install -m 755 tests/v4l2/init.sh "$root/init"
echo "$*" > "$root/scenarios"
pack "$root" "$work/initramfs"

# isa-debug-exit turns a value written to its port into QEMU's exit code, (value << 1) | 1.
set +e
timeout 500 qemu-system-x86_64 -accel tcg -cpu qemu64 -smp 1 -m "${MEMORY_MB:-1024}" -nodefaults -no-user-config -display none \
    -serial stdio -monitor none -no-reboot -icount shift=1,sleep=off \
    -device isa-debug-exit,iobase=0xf4,iosize=0x04 \
    -kernel "$vmlinux" -initrd "$work/initramfs" \
    -append "console=ttyS0 quiet loglevel=2 panic=-1 nokaslr mitigations=off tsc=reliable no_timer_check random.trust_cpu=on cryptomgr.notests" \
    < /dev/null
code=$?
set -e
case $code in
    1) echo "tests/v4l2: all scenarios passed" ;;
    124) echo "tests/v4l2: the machine did not come to an end in 500 s"; exit 1 ;;
    *) echo "tests/v4l2: failed (QEMU ended with $code)"; exit 1 ;;
esac
