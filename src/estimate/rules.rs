//! The rules that were added to the estimators one by one, each of which can be switched off to measure what it gains and costs.

macro_rules! rules {
    ($($(#[doc = $doc:expr])* $name:ident,)*) => {
        /// Which rules are in force; all by default. [`Rules::without`] switches one off for `oapwatch tradeoff --without NAME`.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub struct Rules {
            $($(#[doc = $doc])* pub $name: bool,)*
        }

        impl Default for Rules {
            fn default() -> Self {
                Self { $($name: true,)* }
            }
        }

        impl Rules {
            /// The names of all rules.
            pub const NAMES: &[&str] = &[$(stringify!($name),)*];

            /// All rules but the one of this name; `None` where there is none of it.
            pub fn without(name: &str) -> Option<Self> {
                let mut rules = Self::default();
                match name {
                    $(stringify!($name) => rules.$name = false,)*
                    _ => return None,
                }
                Some(rules)
            }
        }
    };
}

rules! {
    /// Proposal: a source at a residual peak.
    birth,
    /// Proposal: two halves in the place of a source, by the score test.
    split,
    /// Proposal: one source in the place of a close pair.
    merge,
    /// Proposal: all unresolved pairs are merged at once.
    merge_all,
    /// Proposal: a faint source is removed.
    death,
    /// Proposal: a source beyond the sensor's edge moves inside and another one is removed.
    relocate_inside,
    /// `map`, proposal: several users in the place of one source that has the light of several.
    divide,
    /// `map`, proposal: the light of a pair is divided evenly among as many users as it is of.
    balance_pairs,
    /// `map`: fits with tight energy priors and from positions displaced along the ill-determined directions.
    explore_ill_determined,
    /// `map`: the mean along the least determined direction is reported instead of the mode.
    posterior_mean,
    /// A second search, which begins with the matrix pencil, where spots mostly stand apart.
    pencil_start,
    /// In white noise isolated outliers are masked only where that explains the frame at once or nothing else does.
    keep_outliers,
    /// A frame that is not explained is refitted with a background and a width, which are then removed again.
    free_nuisances,
    /// A background or another width is tried in the place of more sources, once a search has ended.
    select_nuisances,
    /// A rotated elliptical PSF is tried in the place of more sources.
    rotated_ellipse,
    /// Sources that do not exceed the misfit around them are removed.
    prune_spurious,
    /// Noise that grows with the light is estimated from the residual, and pixels are weighted by it.
    reweighting,
    /// A fit is aborted once several times its predicted decrease misses the acceptance threshold.
    abort_fits,
    /// A poor fit ends after a few steps that hardly improve it.
    stop_stalled_fits,
    /// Groups of sources that no longer move are fitted no further.
    source_groups,
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
        for (i, name) in Rules::NAMES.iter().enumerate() {
            assert_ne!(Rules::without(name), Some(Rules::default()), "{name}");
            assert!(!Rules::NAMES[..i].contains(name), "{name} is there once");
        }
    }
}
