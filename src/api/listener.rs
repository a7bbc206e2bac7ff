//! Where the API listens: a TCP address or a Unix socket.

use std::fmt;
use std::io;
use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Mode of the Unix socket: whoever may write to it may use the API, so that means the owner and the group.
const SOCKET_MODE: u32 = 0o660;
const UNIX: &str = "unix:";

/// `[api] listen`: `127.0.0.1:8787`, `localhost:8787` or `unix:/run/oapwatch/api.sock`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum Listen {
    Tcp(SocketAddr),
    Unix(PathBuf),
}

/// Why a text is no place to listen on.
#[derive(Debug, thiserror::Error)]
#[error(
    "expected an address such as 127.0.0.1:8787 or localhost:8787, or a socket such as unix:/run/oapwatch/api.sock, \
     found {0:?}"
)]
pub struct ListenError(String);

impl FromStr for Listen {
    type Err = ListenError;

    fn from_str(text: &str) -> Result<Self, ListenError> {
        if let Some(path) = text.strip_prefix(UNIX).filter(|path| !path.is_empty()) {
            return Ok(Self::Unix(path.into()));
        }
        let local = || {
            let port = text.strip_prefix("localhost:")?.parse().ok()?;
            Some(SocketAddr::from((Ipv4Addr::LOCALHOST, port)))
        };
        let address = text.parse().ok().or_else(local);
        address.map(Self::Tcp).ok_or_else(|| ListenError(text.to_owned()))
    }
}

impl TryFrom<String> for Listen {
    type Error = ListenError;

    fn try_from(text: String) -> Result<Self, ListenError> {
        text.parse()
    }
}

impl From<Listen> for String {
    fn from(listen: Listen) -> Self {
        listen.to_string()
    }
}

impl From<SocketAddr> for Listen {
    fn from(address: SocketAddr) -> Self {
        Self::Tcp(address)
    }
}

impl fmt::Display for Listen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => address.fmt(f),
            Self::Unix(path) => write!(f, "{UNIX}{}", path.display()),
        }
    }
}

impl Listen {
    /// Whether only this machine reaches it.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Tcp(address) => address.ip().to_canonical().is_loopback(),
            Self::Unix(_) => true,
        }
    }
}

/// An open listener.
#[derive(Debug)]
pub enum Listener {
    Tcp(TcpListener),
    Unix(UnixListener, SocketFile),
}

impl From<TcpListener> for Listener {
    fn from(listener: TcpListener) -> Self {
        Self::Tcp(listener)
    }
}

impl Listener {
    /// Opens the place. A socket that a process left behind is replaced; one that is answered on is in use.
    pub fn bind(listen: &Listen) -> io::Result<Self> {
        match listen {
            Listen::Tcp(address) => Ok(Self::Tcp(TcpListener::bind(address)?)),
            Listen::Unix(path) => {
                let listener = bind_unix(path)?;
                Ok(Self::Unix(listener, SocketFile::new(path)?))
            }
        }
    }

    /// Where it can be reached, for people.
    pub fn url(&self, scheme: &str) -> io::Result<String> {
        Ok(match self {
            Self::Tcp(listener) => format!("{scheme}://{}", listener.local_addr()?),
            Self::Unix(_, file) => format!("{UNIX}{}", file.path.display()),
        })
    }
}

/// Binds under another name first, so that the socket has its mode before clients find it.
fn bind_unix(path: &Path) -> io::Result<UnixListener> {
    match std::fs::symlink_metadata(path) {
        Ok(meta) if !meta.file_type().is_socket() => {
            let reason = "there is a file of this name that is no socket";
            return Err(io::Error::new(io::ErrorKind::AlreadyExists, reason));
        }
        Ok(_) if UnixStream::connect(path).is_ok() => return Err(io::ErrorKind::AddrInUse.into()),
        _ => {}
    }
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{}", std::process::id()));
    let new = PathBuf::from(name);
    let _ = std::fs::remove_file(&new);
    let listener = UnixListener::bind(&new)?;
    let moved = std::fs::set_permissions(&new, std::fs::Permissions::from_mode(SOCKET_MODE))
        .and_then(|()| std::fs::rename(&new, path));
    if let Err(error) = moved {
        let _ = std::fs::remove_file(&new);
        return Err(error);
    }
    Ok(listener)
}

/// Removes the socket's file at the end, unless another process has put its own there.
#[derive(Debug)]
pub struct SocketFile {
    path: PathBuf,
    inode: u64,
}

impl SocketFile {
    fn new(path: &Path) -> io::Result<Self> {
        Ok(Self {
            inode: std::fs::symlink_metadata(path)?.ino(),
            path: path.to_owned(),
        })
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let is_ours = std::fs::symlink_metadata(&self.path).is_ok_and(|meta| meta.ino() == self.inode);
        if is_ours {
            let _ = std::fs::remove_file(&self.path);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_read_and_written_alike() {
        for (text, expected, is_local) in [
            ("127.0.0.1:8787", "127.0.0.1:8787", true),
            ("localhost:1", "127.0.0.1:1", true),
            ("[::1]:2", "[::1]:2", true),
            ("0.0.0.0:3", "0.0.0.0:3", false),
            ("unix:/run/a.sock", "unix:/run/a.sock", true),
            ("unix:a.sock", "unix:a.sock", true),
        ] {
            let listen: Listen = text.parse().expect(text);
            assert_eq!((listen.to_string().as_str(), listen.is_local()), (expected, is_local));
        }
        for wrong in [
            "",
            "8787",
            "unix:",
            "localhost",
            "localhost:x",
            "/run/a.sock",
            "example.org:1",
        ] {
            let message = wrong.parse::<Listen>().expect_err(wrong).to_string();
            assert!(message.contains(&format!("{wrong:?}")), "{message}");
        }
    }

    #[test]
    fn a_socket_is_private_replaces_a_stale_one_and_is_removed_at_the_end() {
        let dir = tempfile::tempdir().expect("a folder");
        let path = dir.path().join("api.sock");
        let listen = Listen::Unix(path.clone());
        drop(UnixListener::bind(&path).expect("a socket"));
        let first = Listener::bind(&listen).expect("a stale socket is replaced");
        let mode = std::fs::metadata(&path).expect("it is there").permissions().mode();
        assert_eq!(mode & 0o777, SOCKET_MODE);
        let error = Listener::bind(&listen).expect_err("in use");
        assert_eq!(error.kind(), io::ErrorKind::AddrInUse);
        drop(first);
        assert!(!path.exists());
        std::fs::write(&path, "notes").expect("a file");
        Listener::bind(&listen).expect_err("no socket");
        assert_eq!(std::fs::read_to_string(&path).expect("it stays"), "notes");
    }
}
