#!/bin/busybox sh
# First process of the test machine: loads the virtual camera, runs the guest program and reports its exit code.
/bin/busybox --install -s /bin
mount -t devtmpfs dev /dev
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t tmpfs tmp /tmp
ip link set lo up
# Two cameras, with the single-planar and the multi-planar interface: each a capture node and an output node, joined by a loop.
for module in /modules/*; do
    case $module in
        *vivid.ko) insmod "$module" n_devs=2 node_types=0x101,0x101 num_inputs=1,1 input_types=3,3 num_outputs=1,1 output_types=1,1 multiplanar=1,2 ;;
        *) insmod "$module" ;;
    esac
done
cd /tmp
/bin/guest $(cat /scenarios)
code=$?
printf "\\$(printf %o $code)" | dd of=/dev/port bs=1 seek=244 conv=notrunc 2> /dev/null
poweroff -f
