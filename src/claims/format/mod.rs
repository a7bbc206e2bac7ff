//! The formats in which networks write positions down, each as lines: `[claims] format`.

mod cisco_spaces;
mod cot;
mod csv;
mod gad;

use super::config::{Config, Format};
use super::line::{self, LineError};
use crate::claim::Claim;

/// Reads the lines of one file or body in their order.
#[derive(Clone, Debug, Default)]
pub struct LineReader {
    header: Option<csv::Header>,
}

impl LineReader {
    /// Whether the first line of the file has to be read before any other.
    pub fn needs_header(&self, config: &Config) -> bool {
        config.format == Format::Csv && self.header.is_none()
    }

    /// The claim of a line; none of one that is a header.
    pub fn read(&mut self, line: &[u8], config: &Config) -> Result<Option<Claim>, LineError> {
        if config.format != Format::Csv {
            return parse_line(line, config).map(Some);
        }
        match &self.header {
            Some(header) => header.row(line, config).map(Some),
            None => {
                self.header = Some(csv::Header::read(line, config)?);
                Ok(None)
            }
        }
    }
}

/// Reads one line of the network's log in the format of `config`, one whose lines stand alone.
pub fn parse_line(line: &[u8], config: &Config) -> Result<Claim, LineError> {
    match config.format {
        Format::Oapwatch => line::parse_object(&line::object(line)?, config),
        Format::Gad => gad::parse(&line::object(line)?, config),
        Format::CiscoSpaces => cisco_spaces::parse(&line::object(line)?, config),
        Format::Cot => cot::parse(line, config),
        Format::Csv => Err(LineError::NoHeader),
    }
}
