#!/bin/sh
# A compiler for `cargo build` with a stable toolchain: what reads what comes from outside counts its edges and compares for libFuzzer,
# everything else is built as ever.
rustc=$1
shift
for argument in "$@"; do
    if [ "$previous" = --crate-name ]; then
        crate=$argument
    fi
    previous=$argument
done
case "$crate" in
oapwatch* | toml* | winnow | serde_json | prost | tiff | tract_onnx | npyz)
    set -- "$@" -Ccodegen-units=1 -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 \
        -Cllvm-args=-sanitizer-coverage-inline-8bit-counters -Cllvm-args=-sanitizer-coverage-pc-table \
        -Cllvm-args=-sanitizer-coverage-trace-compares
    ;;
esac
exec "$rustc" "$@"
