#!/usr/bin/env bash
# Cuts the power of a virtual machine in which the daemon writes its journal. Usage: run.sh OAPWATCH_BINARY [OPTION OF cuts.py...].
# What it makes is kept under target/power-cuts. Needs: qemu-system-x86 busybox-static kmod cpio xz-utils e2fsprogs python3.
set -euo pipefail
cd "$(dirname "$0")/../.."
work=$PWD/target/power-cuts
program=$1
shift
mkdir -p "$work"
. tests/machine/kernel.sh

root=$work/root
rm -rf "$root"
mkdir -p "$root"/{bin,dev,proc,tmp,disk,lib64,www/cgi-bin}
cp "$(command -v busybox)" "$root/bin/busybox"
install_modules "$root" virtio_pci virtio_blk crc32c_generic ext4
install_program "$program" oapwatch "$root"
install -m 755 tests/power_cuts/init.sh "$root/init"
install -m 755 tests/power_cuts/hook.sh "$root/www/cgi-bin/hook"
install -m 644 tests/power_cuts/oapwatch.toml "$root/oapwatch.toml"
# The webhooks' client wants an authority, though nothing is encrypted here.
install -D -m 644 tests/data/tls/ca.pem "$root/etc/ssl/certs/ca-certificates.crt"
(umask 077 && echo "whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw" > "$root/secret")
{
    cat tests/power_cuts/scene.toml
    # Sixteen places in a field of 250 m; a beam comes to the next every 0.3 s, stays for 2.5 s and is back after 5 s.
    for k in {0..15}; do
        printf '[[intruder]]\nname = "i-%d"\nmotion.still = [%d, %d]\n' "$k" $((k % 4 * 60 - 90)) $((k / 4 * 60 - 90))
        printf 'present = { from_s = %d.%d, until_s = %d.%d, every_s = 5.0 }\n' \
            $((k * 3 / 10)) $((k * 3 % 10)) $(((k * 3 + 25) / 10)) $(((k * 3 + 25) % 10))
    done
} > "$root/scene.toml"
pack "$root" "$work/initramfs"
exec python3 tests/power_cuts/cuts.py "$vmlinux" "$work" "$@"
