//! The rules that were added to the estimators one by one, each of which can be switched off to measure what it gains and costs.

macro_rules! rules {
    (of_frames: { $($(#[doc = $doc:expr])* $name:ident,)* } of_sequences: { $($(#[doc = $of:expr])* $later:ident,)* }) => {
        /// Which rules are in force; all by default. [`Rules::without`] switches one off for `oapwatch tradeoff --without NAME`
        /// and `oapwatch study --without NAME`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub struct Rules {
            $($(#[doc = $doc])* pub $name: bool,)*
            $($(#[doc = $of])* pub $later: bool,)*
        }

        impl Default for Rules {
            fn default() -> Self {
                Self { $($name: true,)* $($later: true,)* }
            }
        }

        impl Rules {
            /// The names of the rules by which a frame is searched.
            pub const NAMES: &[&str] = &[$(stringify!($name),)*];

            /// The names of those by which `sequence` puts frames together.
            pub const OF_SEQUENCES: &[&str] = &[$(stringify!($later),)*];

            /// All rules but the one of this name; `None` where there is none of it.
            pub fn without(name: &str) -> Option<Self> {
                let mut rules = Self::default();
                match name {
                    $(stringify!($name) => rules.$name = false,)*
                    $(stringify!($later) => rules.$later = false,)*
                    _ => return None,
                }
                Some(rules)
            }
        }
    };
}

rules! {
    of_frames: {
    /// Proposal: a source at a residual peak. For sources too faint for the start, which few cells of the trade-off hold: needed in one of
    /// 240 frames with a background, spikes or dead pixels.
    birth,
    /// Proposal: two halves in the place of a source, by the score test. Needed most in E6/64.
    split,
    /// Proposal: one source in the place of a close pair. Needed in P1/64.
    merge,
    /// Proposal: all unresolved pairs are merged at once. Saves time, a third to a half where there are many sources.
    merge_all,
    /// Proposal: a faint source is removed. Needed most in E1/100 with 20 emitters and in E2/64 with a background.
    death,
    /// Proposal: a source beyond the sensor's edge moves inside and another one is removed. Needed in E1/10.
    relocate_inside,
    /// `map`, proposal: several users in the place of one source that has the light of several. Needed most in E8/64.
    divide,
    /// `map`, proposal: the light of a pair is divided evenly among as many users as it is of. Saves steps in E4/64 to E8/64.
    balance_pairs,
    /// `map`: fits with tight energy priors and from positions displaced along the ill-determined directions. Needed in P8/10 and P8/20,
    /// whose mean squared error it lowers by a third.
    explore_ill_determined,
    /// `map`: the mean along the least determined direction is reported instead of the mode.
    posterior_mean,
    /// A second search, which begins with the matrix pencil, where spots mostly stand apart. Saves time in P2/64 and E2/64.
    pencil_start,
    /// The search of a crowded frame begins with the maxima of the embedded network, where that is for such frames. Saves half of the time with
    /// 20 and 40 emitters.
    network_start,
    /// In white noise isolated outliers are masked only where that explains the frame at once or nothing else does. Needed in E4/20 with a
    /// background.
    keep_outliers,
    /// A frame that is not explained is refitted with a background and a width, which are then removed again. Saves time in E4/20 with a
    /// background.
    free_nuisances,
    /// A background or another width is tried in the place of more sources, once a search has ended. Needed most in P8/60 with a background.
    select_nuisances,
    /// A frame that another width or an elongated spot explains is searched from there, before it is asked whether its lens is another. Needed
    /// most in E2/64 with the condition `ellipse`.
    explain_by_width,
    /// Where emitters explain the frame: a close pair that another width of all spots, or an ellipse, explains as well is one spot. Needed where the
    /// axes of spots differ by less than a plain fit shows.
    width_for_pairs,
    /// A frame that round spots do not explain is searched with the ellipse that most recent frames showed. Needed where spots overlap through
    /// a lens with astigmatism (`oapwatch study lens`).
    remember_ellipse,
    /// What the bright spots of recent frames have in common, too faint for a single frame, is taken for the lens's. Needed where a faint ghost
    /// stands beside every user (`oapwatch study lens-alerts --only ghost`).
    stack_misfits,
    /// The spot's shape is learned where frames show that spots differ from the PSF.
    learn_spots,
    /// The spots' width is learned from frames together. Needed where it differs from the configured one by a few per cent.
    learn_width,
    /// A rotated elliptical PSF is tried in the place of more sources. Needed with the condition `ellipse`.
    rotated_ellipse,
    /// Sources that do not exceed the misfit around them are removed. No cell of the trade-off needs it; the scene `hazy-noon` does: without
    /// it an alert more is raised.
    prune_spurious,
    /// Noise that grows with the light is estimated from the residual, and pixels are weighted by it. Needed with the condition `gains`.
    reweighting,
    /// A fit is aborted once several times its predicted decrease misses the acceptance threshold. Saves a third of the time.
    abort_fits,
    /// A poor fit ends after a few steps that hardly improve it. Saves 5 to 14 % of the time.
    stop_stalled_fits,
    /// A fit exceeds its number of steps while each improves it much. Needed by `pencil-fit`.
    extend_fast_fits,
    /// Groups of sources that no longer move are fitted no further. Saves a quarter of the time with 20 emitters.
    source_groups,
    /// On a large sensor spots that stand apart are searched window by window. Saves nine tenths of the time, and finds all of 200 emitters
    /// instead of 80.
    windows,
    }
    of_sequences: {
    /// A newcomer whose light in all frames is less than the penalty of a source over them is forgotten.
    confirm_newcomers,
    /// A faint newcomer is forgotten when two or three frames do not show it again.
    doubt_faint_newcomers,
    /// Where the newest frame alone shows those who are known but not the newcomer, there is none.
    ask_frame_alone,
    /// A newcomer beside others has to explain the frames better than that these have turned.
    turns_before_newcomers,
    /// The window is searched together with a frame that contradicts what is known.
    search_again,
    /// Where pairs are ambiguous the window is searched from its principal components.
    principal_components,
    /// Emitters are born where the residuals of all frames together peak.
    summed_residuals,
    /// The accelerations of who roams are learned, and the window ends where courses are not straight.
    follow_accelerations,
    /// Velocities count as those of people who stand, walk, cycle or drive.
    weigh_speeds,
    /// Who has gone dark is not reported before it is dropped.
    hide_dark,
    /// Frames through another lens than the configured one are answered one by one. Needed in `oapwatch study lens-alerts`.
    watch_lens,
    /// A steady background is taken off and odd pixels are masked, through a lens whose spots are Gaussians. Needed in
    /// `oapwatch study sensor-alerts`.
    watch_sensor,
    }
}

#[cfg(test)]
mod tests {
    use super::Rules;

    #[test]
    fn one_rule_is_switched_off_by_its_name() {
        let rules = Rules::without("relocate_inside").expect("a rule's name");
        assert!(!rules.relocate_inside);
        assert_eq!(
            Rules {
                relocate_inside: true,
                ..rules
            },
            Rules::default()
        );
        assert_eq!(Rules::without("relocate_outside"), None);
        let names = [Rules::NAMES, Rules::OF_SEQUENCES].concat();
        for (i, name) in names.iter().enumerate() {
            assert_ne!(Rules::without(name), Some(Rules::default()), "{name}");
            assert!(!names[..i].contains(name), "{name} is there once");
        }
    }
}
