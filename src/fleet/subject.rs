//! Subjects: `oapwatch.<site>.<station>.<topic>`.

use std::fmt;

use crate::monitor::StationName;

/// First token of every subject.
const ROOT: &str = "oapwatch";
/// Longest name of a site or station; a subject is sent with every message.
const LONGEST_NAME: usize = 64;

/// What a message is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Topic {
    Alert,
    Positions,
    Health,
    Pose,
}

impl Topic {
    pub const ALL: [Self; 4] = [Self::Alert, Self::Positions, Self::Health, Self::Pose];

    pub fn name(self) -> &'static str {
        match self {
            Self::Alert => "alert",
            Self::Positions => "positions",
            Self::Health => "health",
            Self::Pose => "pose",
        }
    }
}

/// A parsed subject.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Subject {
    pub name: StationName,
    pub topic: Topic,
}

/// Whether a site or station may be called so: letters, digits, `-` and `_`, because dots, spaces and wildcards have a meaning in
/// subjects.
pub(super) fn is_name(text: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    (1..=LONGEST_NAME).contains(&text.len()) && text.chars().all(is_plain)
}

impl Subject {
    /// `None` where the text is no subject of ours.
    pub fn parse(text: &str) -> Option<Self> {
        let mut tokens = text.split('.');
        let (root, site, station, topic) = (tokens.next()?, tokens.next()?, tokens.next()?, tokens.next()?);
        let topic = Topic::ALL.into_iter().find(|t| t.name() == topic)?;
        let is_ours = root == ROOT && tokens.next().is_none() && is_name(site) && is_name(station);
        is_ours.then(|| Self {
            name: StationName {
                site: site.to_owned(),
                station: station.to_owned(),
            },
            topic,
        })
    }

    /// Subjects with this topic of all stations of a site, or of all sites.
    pub fn of_all(site: Option<&str>, topic: Topic) -> String {
        format!("{ROOT}.{}.*.{}", site.unwrap_or("*"), topic.name())
    }
}

impl fmt::Display for Subject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let StationName { site, station } = &self.name;
        write!(f, "{ROOT}.{site}.{station}.{}", self.topic.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_subject_is_read_as_it_is_written() {
        let text = "oapwatch.harbour.ap-7.positions";
        let subject = Subject::parse(text).unwrap();
        assert_eq!(subject.name.station, "ap-7");
        assert_eq!(subject.topic, Topic::Positions);
        assert_eq!(subject.to_string(), text);
        assert_eq!(Subject::of_all(None, Topic::Alert), "oapwatch.*.*.alert");
        assert_eq!(
            Subject::of_all(Some("harbour"), Topic::Alert),
            "oapwatch.harbour.*.alert"
        );
    }

    #[test]
    fn other_subjects_are_not_ours() {
        for text in [
            "",
            "oapwatch",
            "oapwatch.a.b",
            "oapwatch.a.b.news",
            "oapwatch.a.b.alert.x",
            "oapwatch..b.alert",
            "oapwatch.a.b c.alert",
            "other.a.b.alert",
            "oapwatch.a.*.alert",
        ] {
            assert_eq!(Subject::parse(text), None, "{text}");
        }
    }
}
