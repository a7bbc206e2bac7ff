//! The kernel's V4L2 structs and constants as the crate of the same name gives them, for 64-bit Linux.
//!
//! That crate runs bindgen at every build, which takes libclang and nineteen crates. This one holds bindgen's output; its
//! README says how it was made.
#![allow(clippy::all)]
#![allow(non_camel_case_types, non_snake_case, non_upper_case_globals)]

#[cfg(not(all(target_os = "linux", target_pointer_width = "64")))]
compile_error!("these bindings were generated for 64-bit Linux");

include!("bindings.rs");

/// Sizes from the kernel's ABI: a request number carries its struct's size.
const _: () = {
    assert!(std::mem::size_of::<v4l2_capability>() == 104);
    assert!(std::mem::size_of::<v4l2_fmtdesc>() == 64);
    assert!(std::mem::size_of::<v4l2_format>() == 208);
    assert!(std::mem::size_of::<v4l2_requestbuffers>() == 20);
    assert!(std::mem::size_of::<v4l2_buffer>() == 88);
    assert!(std::mem::size_of::<v4l2_plane>() == 64);
    assert!(std::mem::size_of::<v4l2_streamparm>() == 204);
    assert!(std::mem::size_of::<v4l2_frmsizeenum>() == 44);
    assert!(std::mem::size_of::<v4l2_queryctrl>() == 68);
    assert!(std::mem::size_of::<v4l2_control>() == 8);
};
