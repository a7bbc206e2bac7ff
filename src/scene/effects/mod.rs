//! The effects: one file each, with its equation and range of validity.

mod aberrations;
mod aperture;
mod attenuation;
pub(super) mod attitude;
mod background;
mod dark_current;
mod defects;
mod distortion;
mod fading;
mod frame_loss;
mod gain;
mod glint;
mod motion_blur;
mod pointing;
mod quantisation;
mod saturation;
mod shot_noise;
mod spot;
mod table;
mod thermal_noise;
mod vibration;
mod vignetting;
mod wander;

pub use aberrations::Aberrations;
pub use aperture::ExactAperture;
pub use attenuation::Attenuation;
pub use attitude::Attitude;
pub use background::Background;
pub use dark_current::DarkCurrent;
pub use defects::Defects;
pub use distortion::DistortionTable;
pub use fading::Fading;
pub use frame_loss::{Fate, FrameLoss};
pub use gain::Gain;
pub use glint::Glint;
pub use motion_blur::MotionBlur;
pub use pointing::Pointing;
pub use quantisation::Quantisation;
pub use saturation::Saturation;
pub use shot_noise::ShotNoise;
pub use spot::{Pupil, Rim, SpotEffect, Zernike};
pub use thermal_noise::ThermalNoise;
pub use vibration::Vibration;
pub use vignetting::Vignetting;
pub use wander::Wander;

pub(super) use aberrations::Rays;
pub(super) use aperture::Capture;
pub(super) use attitude::Pose;
pub(super) use defects::DefectMap;
pub(super) use fading::{Fades, Turbulence};
pub(super) use quantisation::Converter;
pub(super) use spot::SpotImages;
pub(super) use vibration::Shaker;

use serde::{Deserialize, Serialize};

use super::effect::{Effect, effect_list};
use crate::toml_file::{Key, OutOfRange};
use table::Table;

macro_rules! declare_effects {
    ($($number:literal $effect:ident $field:ident: $table:ty,)*) => {
        /// `[effects]`: an effect that is not named is not simulated and costs nothing.
        #[derive(Clone, Debug, Default, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Effects {
            $(pub $field: Option<$table>,)*
        }

        impl Effects {
            pub(in crate::scene) fn validate(&self, field: &Key) -> Result<(), OutOfRange> {
                $(if let Some(table) = &self.$field {
                    table.validate(&field.at(stringify!($field)))?;
                })*
                Ok(())
            }

            /// Whether the scene names `effect` under `[effects]`.
            pub fn names(&self, effect: Effect) -> bool {
                match effect {
                    $(Effect::$effect => self.$field.is_some(),)*
                    _ => false,
                }
            }

            /// Takes `effect` out.
            pub fn remove(&mut self, effect: Effect) {
                match effect {
                    $(Effect::$effect => self.$field = None,)*
                    _ => {}
                }
            }
        }
    };
}

effect_list!(declare_effects);
