//! Frames together: emitters keep their positions and velocities from frame to frame, while each frame's energies are free.
//!
//! Every answer is the maximum likelihood of this frame and all before it that still tell something. Independently fading beams are
//! told apart where no single frame could (the multi-snapshot problem of array processing: Ottersten, Viberg and Stoica, 1993).
//! Recent frames are kept as a window that is fitted anew where its linearisation no longer holds; older ones leave it as information on
//! all positions and velocities together.

mod acceleration_bank;
mod chances;
mod course;
mod joint_information;
mod lens_watch;
mod local_quadratic;
mod motion;
mod odd_pixels;
mod outlook;
mod report;
mod reprojection;
mod residual_map;
mod revision;
mod revision_schedule;
mod search;
mod sensor_watch;
mod sequence_estimator;
mod snapshot;
mod spot_width;
mod steady_background;
mod straying;
mod subspace;
mod target;
mod upkeep;
mod window;
mod window_fit;

pub(crate) use lens_watch::LensWatch;
pub(crate) use sensor_watch::SensorWatch;
pub(crate) use sequence_estimator::SequenceEstimator;
