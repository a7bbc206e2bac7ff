#!/usr/bin/env bash
# Boots a Debian with systemd under QEMU's software emulation, installs target/oapwatch.deb in it and runs guest.sh there.
# Needs root (or fakeroot) for mmdebstrap. Everything it makes is kept under target/deploy-vm for the next run.
set -euo pipefail
cd "$(dirname "$0")/../.."
work=$PWD/target/deploy-vm
deb=$PWD/target/oapwatch.deb
mkdir -p "$work"
for tool in qemu-system-x86_64 mmdebstrap mksquashfs busybox depmod cpio xz apt-get dpkg-deb; do
    if ! command -v "$tool" > /dev/null; then
        echo "tests/deploy: $tool is missing: apt-get install qemu-system-x86 mmdebstrap squashfs-tools busybox-static kmod cpio xz-utils"
        exit 1
    fi
done
[ -f "$deb" ] || { echo "tests/deploy: target/oapwatch.deb is missing; run make deb"; exit 1; }

suite=$(. /etc/os-release && echo "$VERSION_CODENAME")
packages=systemd-sysv,udev,kmod,curl,python3-minimal,ca-certificates,sqlite3,nats-server,openssl
base=$work/root-$(echo "$suite $packages, examples" | cksum | cut -d' ' -f1).tar
if [ ! -f "$base" ]; then
    echo "Making a minimal Debian $suite (about a minute)"
    mmdebstrap --quiet --format=tar --variant=minbase --include=$packages \
        --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-include=/usr/share/doc/oapwatch/*' \
        --dpkgopt='path-exclude=/usr/share/locale/*' \
        "$suite" "$work/root.tar.part"
    mv "$work/root.tar.part" "$base"
fi
. tests/machine/kernel.sh

initramfs() {
    local dir=$work/initramfs
    rm -rf "$dir"
    mkdir -p "$dir"/{bin,dev,proc,sys,lower,upper,root}
    cp /bin/busybox "$dir/bin/"
    install_modules "$dir" virtio_pci virtio_blk squashfs overlay
    cat > "$dir/init" <<'INIT'
#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t devtmpfs dev /dev; mount -t proc proc /proc; mount -t sysfs sys /sys
for m in /modules/*; do insmod "$m" 2>/dev/null; done
n=0; while [ ! -b /dev/vda ] && [ $n -lt 50 ]; do sleep 0.1; n=$((n+1)); done
mount -t squashfs -o ro /dev/vda /lower || { echo "no root"; poweroff -f; }
mount -t tmpfs -o size=400m tmpfs /upper; mkdir /upper/data /upper/work
mount -t overlay -o lowerdir=/lower,upperdir=/upper/data,workdir=/upper/work overlay /root
umount /proc /sys
exec switch_root /root /lib/systemd/systemd
INIT
    chmod +x "$dir/init"
    pack "$dir" "$work/initramfs.cpio"
}

root_image() {
    local dir=$work/root
    rm -rf "$dir"
    mkdir -p "$dir"
    tar -C "$dir" --exclude='./dev/*' -xf "$base"
    for path in $(needs vivid); do
        install -D "$path" "$dir/lib/modules/$version/${path##*/lib/modules/$version/}"
    done
    cp "$kernel/lib/modules/$version"/modules.{builtin,order}* "$dir/lib/modules/$version/"
    depmod -b "$dir" "$version"
    cp "$deb" "$dir/oapwatch.deb"
    cp "$work/upgrade.deb" "$dir/upgrade.deb"
    install -m 755 tests/deploy/guest.sh "$dir/guest.sh"
    mkdir "$dir/guide" "$dir/fleet"
    # Each block of commands of the operator's guide, and of a fleet's set-up, in order.
    blocks() { awk -v dir="$1" '/^```sh$/ { n++; on = 1; next } /^```$/ { on = 0 } on { print > sprintf("%s/%02d.sh", dir, n) }'; }
    blocks "$dir/guide" < docs/operator.md
    sed -n '/^## Set-up$/,/^## What is published$/p' docs/fleet.md | blocks "$dir/fleet"
    install -m 644 tests/deploy/receiver.py "$dir/receiver.py"
    cat > "$dir/etc/systemd/system/guest.service" <<'UNIT'
[Unit]
After=multi-user.target
[Service]
Type=oneshot
ExecStart=/guest.sh
StandardOutput=tty
StandardError=tty
TTYPath=/dev/ttyS0
[Install]
WantedBy=multi-user.target
UNIT
    # Not multi-user.target's own dependency loop: start it from a timer-free wants of default.target.
    mkdir -p "$dir/etc/systemd/system/default.target.wants"
    ln -sf ../guest.service "$dir/etc/systemd/system/default.target.wants/guest.service"
    for unit in systemd-timesyncd systemd-udev-settle apt-daily.timer apt-daily-upgrade.timer dpkg-db-backup.timer e2scrub_all.timer \
        fstrim.timer getty@tty1 serial-getty@ttyS0 systemd-update-utmp systemd-random-seed; do
        case $unit in *.timer) ;; *) unit=$unit.service ;; esac
        ln -sf /dev/null "$dir/etc/systemd/system/$unit"
    done
    rm -f "$work/root.squashfs"
    mksquashfs "$dir" "$work/root.squashfs" -comp gzip -Xcompression-level 1 -quiet -no-progress
}

# The same package under a later version, with another config of its own, as an upgrade brings it.
upgrade() {
    local dir=$work/upgrade
    rm -rf "$dir"
    dpkg-deb --raw-extract "$deb" "$dir"
    sed -i 's/^Version: .*/&+later/' "$dir/DEBIAN/control"
    echo "# shipped with a later version" >> "$dir/etc/oapwatch/oapwatch.toml"
    dpkg-deb --root-owner-group -Zgzip -z1 --build "$dir" "$work/upgrade.deb" > /dev/null
    rm -rf "$dir"
}

initramfs
upgrade
root_image
echo "Booting (software emulation; a few minutes at most)"
status=0
timeout 1500 qemu-system-x86_64 -accel tcg -cpu max -smp 1 -m 1024 -nodefaults -display none -no-reboot \
    -kernel "$vmlinux" -initrd "$work/initramfs.cpio" \
    -append "console=ttyS0 quiet loglevel=2 panic=-1 nokaslr mitigations=off tsc=reliable no_timer_check random.trust_cpu=on cryptomgr.notests systemd.show_status=false rd.systemd.show_status=false" \
    -drive "file=$work/root.squashfs,format=raw,if=virtio,readonly=on" \
    -device isa-debug-exit,iobase=0xf4,iosize=0x04 -serial stdio </dev/null | tee "$work/log" || status=${PIPESTATUS[0]}
# The guest writes v to the port and QEMU ends with (v << 1) | 1.
grep -a '^ok\|^not ok' "$work/log" > "$work/results" || true
failed=$(grep -ac '^not ok' "$work/results" || true)
passed=$(grep -ac '^ok' "$work/results" || true)
echo "$passed passed, $failed failed"
[ "$status" = 33 ] && [ "$failed" = 0 ] && grep -aq "^# all $passed checks were made" "$work/log"
