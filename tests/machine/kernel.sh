# Sourced by the tests in virtual machines: Debian's kernel, unpacked under target/machine and kept for the next run.
# Gives $kernel (its files), $version, $vmlinux (unpacked, which saves the guest from doing it under emulation),
# `needs MODULE...` and `install_program FILE NAME ROOT`.
machine=$PWD/target/machine
kernel=$machine/kernel
vmlinux=$machine/vmlinux
mkdir -p "$machine"

if [ ! -d "$kernel" ]; then
    echo "Fetching Debian's kernel"
    package=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: //p' | head -n 1)
    rm -rf "$kernel.part" "$machine"/linux-image-*.deb
    (cd "$machine" && apt-get download -q "$package" 2> /dev/null)
    mkdir -p "$kernel.part"
    dpkg-deb --extract "$machine"/linux-image-*.deb "$kernel.part"
    rm "$machine"/linux-image-*.deb
    depmod -b "$kernel.part" "$(ls "$kernel.part/lib/modules")"
    mv "$kernel.part" "$kernel"
fi
version=$(ls "$kernel/lib/modules")

if [ ! -f "$vmlinux" ]; then
    vmlinuz=$kernel/boot/vmlinuz-$version
    offset=$(grep -abo $'\xfd7zXZ' "$vmlinuz" | head -n 1 | cut -d: -f1 || true)
    [ -n "$offset" ] || { echo "no xz stream in $vmlinuz"; exit 1; }
    # The stream is followed by other data, at which xz complains after having unpacked everything.
    tail -c "+$((offset + 1))" "$vmlinuz" | xz -dc --single-stream > "$vmlinux.part" 2> /dev/null || true
    mv "$vmlinux.part" "$vmlinux"
fi

# Paths of the modules and all they need, in loading order.
needs() {
    for module in "$@"; do
        modprobe -d "$kernel" -S "$version" --show-depends "$module" | sed -n 's/^insmod \([^ ]*\).*/\1/p'
    done | awk '!seen[$0]++'
}

# A program with the libraries it is linked to, wherever they are.
install_program() {
    install -D -m 755 "$1" "$3/bin/$2"
    strip --strip-debug "$3/bin/$2" 2> /dev/null || true
    { ldd "$1" 2> /dev/null || true; } | { grep -o '/[^ )]*' || true; } | while read -r library; do
        [ -e "$3$library" ] || install -D -m 755 "$(readlink -f "$library")" "$3$library"
    done
}

# The modules, named so that their order is that of loading.
install_modules() {
    local root=$1 n=10
    shift
    mkdir -p "$root/modules"
    for module in $(needs "$@"); do
        cp "$module" "$root/modules/$n-$(basename "$module")"
        n=$((n + 1))
    done
}

# Packs folder $1 as the machine's first file system, $2. Not compressed: the guest would unpack it under emulation.
pack() {
    (cd "$1" && find . | cpio --quiet -o -H newc) > "$2"
}
