//! Messages on the wire: a length of four bytes, little-endian, then the protobuf.

use prost::Message;
use tokio::io::{AsyncRead, AsyncReadExt};

use super::message::SapientMessage;

/// Longest message that is read; ours are a few kilobytes. A longer one ends the connection: what follows it cannot be found.
const LONGEST: usize = 1 << 20;

/// Why nothing more can be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum ReadError {
    #[error("the other side closed the connection: {0}")]
    Closed(#[from] std::io::Error),
    #[error("the other side announced a message of {0} bytes; at most {LONGEST} are read")]
    TooLong(u32),
}

pub(super) fn encode(message: &SapientMessage) -> Vec<u8> {
    let length = message.encoded_len();
    let mut bytes = Vec::with_capacity(4 + length);
    bytes.extend_from_slice(&u32::try_from(length).unwrap_or(u32::MAX).to_le_bytes());
    bytes.extend_from_slice(&message.encode_to_vec());
    bytes
}

/// Reads one message; none where its bytes are no message, after which the next can be read.
pub(super) async fn read(stream: &mut (impl AsyncRead + Unpin)) -> Result<Option<SapientMessage>, ReadError> {
    let mut length = [0; 4];
    stream.read_exact(&mut length).await?;
    let length = u32::from_le_bytes(length);
    if length as usize > LONGEST {
        return Err(ReadError::TooLong(length));
    }
    // No more is taken from memory than has come.
    let mut bytes = Vec::new();
    stream.take(length.into()).read_to_end(&mut bytes).await?;
    if bytes.len() < length as usize {
        return Err(std::io::Error::from(std::io::ErrorKind::UnexpectedEof).into());
    }
    Ok(SapientMessage::decode(&bytes[..]).ok())
}
