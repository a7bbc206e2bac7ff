//! The effects: one small file each, with its equation and where it is valid.

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
pub(super) use vibration::Shaker;

use serde::{Deserialize, Serialize};

use super::error::{Error, Field};

/// A table of `[effects]`.
pub(super) trait Table {
    /// Checks every field; `field` is the table's own name.
    fn validate(&self, field: &Field) -> Result<(), Error>;
}

impl<T: Table> Table for Vec<T> {
    fn validate(&self, field: &Field) -> Result<(), Error> {
        let mut items = self.iter().enumerate();
        items.try_for_each(|(k, item)| item.validate(&field.index(k)))
    }
}

/// Declares `[effects]` and, for each table, the [`Effect`] that its random streams are keyed by.
macro_rules! effects {
    ($($number:literal $effect:ident $field:ident: $table:ty,)*) => {
        /// `[effects]`: what is not named does not happen and costs nothing.
        #[derive(Clone, Debug, Default, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct Effects {
            $(pub $field: Option<$table>,)*
        }

        /// Everything that a scene can switch on. The numbers key the random streams: they never change.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[repr(usize)]
        pub enum Effect {
            /// Emitters drawn anew for every frame.
            Population = 0,
            /// Roaming emitters.
            Motion = 1,
            /// Defocus and diffraction.
            Blur = 2,
            ClaimDelay = 3,
            ClaimLoss = 4,
            ClaimNoise = 5,
            $($effect = $number,)*
        }

        impl Effects {
            pub(super) fn validate(&self, field: &Field) -> Result<(), Error> {
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

        impl Effect {
            /// Every effect that has a table under `[effects]`, in the order of the light's way.
            pub const TABLES: &[Self] = &[$(Self::$effect,)*];

            /// The key of its table under `[effects]`, or what else the scene calls it.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$effect => stringify!($field),)*
                    Self::Population => "random_emitters",
                    Self::Motion => "motion",
                    Self::Blur => "blur",
                    Self::ClaimDelay => "claims.delay",
                    Self::ClaimLoss => "claims.lost",
                    Self::ClaimNoise => "claims.noise",
                }
            }
        }
    };
}

effects! {
    10 Attenuation attenuation: Attenuation,
    11 Fading fading: Fading,
    12 Pointing pointing: Pointing,
    13 ExactAperture exact_aperture: ExactAperture,
    14 Attitude attitude: Attitude,
    15 Vibration vibration: Vec<Vibration>,
    16 Wander wander: Wander,
    17 MotionBlur motion_blur: MotionBlur,
    18 Distortion distortion: DistortionTable,
    19 Vignetting vignetting: Vignetting,
    20 Background background: Background,
    21 Glint glint: Vec<Glint>,
    22 Gain gain: Gain,
    23 DarkCurrent dark_current: DarkCurrent,
    24 ShotNoise shot_noise: ShotNoise,
    25 Saturation saturation: Saturation,
    26 ThermalNoise thermal_noise: ThermalNoise,
    27 Defects defects: Defects,
    28 Quantisation quantisation: Quantisation,
    29 FrameLoss frame_loss: FrameLoss,
    30 Aberrations aberrations: Aberrations,
}

impl Effect {
    /// Room for every number.
    pub(super) const ROOM: usize = 31;
}
