//! Where the autopilot's telemetry comes from: `udpin:ADDR:PORT`, `udpout:ADDR:PORT`, `tcp:ADDR:PORT`.

use std::str::FromStr;

/// A place on the network. Host names are resolved whenever a connection is made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Endpoint {
    /// Listens there; answers go to whoever sent last.
    UdpIn(String),
    /// Sends there first, and listens to what comes back.
    UdpOut(String),
    /// Connects there.
    Tcp(String),
}

#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected udpin:ADDR:PORT, udpout:ADDR:PORT or tcp:ADDR:PORT, found {0:?}")]
pub struct EndpointError(pub String);

impl FromStr for Endpoint {
    type Err = EndpointError;

    fn from_str(text: &str) -> Result<Self, EndpointError> {
        let refused = || EndpointError(text.to_owned());
        let (kind, address) = text.split_once(':').ok_or_else(refused)?;
        let (host, port) = address.rsplit_once(':').ok_or_else(refused)?;
        let is_port = port.parse::<u16>().is_ok_and(|port| port > 0 || kind == "udpin");
        let is_bracketed = host.starts_with('[') && host.ends_with(']');
        if !is_port || host.is_empty() || (host.contains(':') && !is_bracketed) || host.contains(char::is_whitespace) {
            return Err(refused());
        }
        match kind {
            "udpin" => Ok(Self::UdpIn(address.to_owned())),
            "udpout" => Ok(Self::UdpOut(address.to_owned())),
            "tcp" | "tcpout" => Ok(Self::Tcp(address.to_owned())),
            _ => Err(refused()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_read_or_refused_with_what_was_expected() {
        let udpin = Endpoint::UdpIn("127.0.0.1:14550".to_owned());
        assert_eq!("udpin:127.0.0.1:14550".parse(), Ok(udpin));
        assert_eq!("tcp:[::1]:5760".parse(), Ok(Endpoint::Tcp("[::1]:5760".to_owned())));
        assert_eq!("tcpout:fc:5760".parse(), Ok(Endpoint::Tcp("fc:5760".to_owned())));
        for wrong in [
            "",
            "udpin",
            "udpin:14550",
            "udpin:a:b",
            "serial:/dev/ttyS0:57600",
            "tcp:::1:5760",
            "udp:a:0",
            "udpout: :1",
        ] {
            let refused = wrong.parse::<Endpoint>().unwrap_err().to_string();
            assert!(refused.contains("expected udpin:ADDR:PORT"), "{refused}");
        }
    }
}
