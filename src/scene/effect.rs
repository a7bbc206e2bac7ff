//! The effects by name, and the numbers that key their random streams.

/// Calls a macro with every effect that has a table under `[effects]`: its number, name, key and table, in the order in which light passes them.
macro_rules! effect_list {
    ($declare:ident) => {
        $declare! {
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
            31 Spot spot: SpotEffect,
        }
    };
}
pub(super) use effect_list;

macro_rules! declare_effect {
    ($($number:literal $effect:ident $field:ident: $table:ty,)*) => {
        /// Every effect that a scene can enable. The numbers key the random streams and never change.
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
            /// Motion of the platform.
            Platform = 6,
            /// What the autopilot says of it.
            Telemetry = 7,
            $($effect = $number,)*
        }

        impl Effect {
            /// Every effect that has a table under `[effects]`, in the order in which light passes them.
            pub const TABLES: &[Self] = &[$(Self::$effect,)*];

            /// The key of its table under `[effects]`, or its other name in the scene.
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$effect => stringify!($field),)*
                    Self::Population => "random_emitters",
                    Self::Motion => "motion",
                    Self::Blur => "blur",
                    Self::ClaimDelay => "claims.delay",
                    Self::ClaimLoss => "claims.lost",
                    Self::ClaimNoise => "claims.noise",
                    Self::Platform => "platform",
                    Self::Telemetry => "platform.telemetry",
                }
            }
        }
    };
}

effect_list!(declare_effect);

impl Effect {
    /// Length of an array indexed by effect number.
    pub(super) const SLOTS: usize = 32;
}
