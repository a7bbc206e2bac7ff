//! The estimators from outside, on frames that are drawn here from the optics alone.

mod bound;
mod daylight;
mod frames;
mod hot_pixels;
mod lens;
mod lens_memory;
mod lens_watch;
mod moving;
mod sequence;
mod shot_noise;
mod windows;
