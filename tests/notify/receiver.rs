//! Receivers on the loopback address that remember what they were sent.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use axum::Router;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use serde_json::Value;

/// A request as the receiver saw it.
#[derive(Clone, Debug)]
pub struct Seen {
    pub headers: HashMap<String, String>,
    pub body: Vec<u8>,
    pub accepted: bool,
}

impl Seen {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    pub fn what(&self) -> (String, String) {
        let json = self.json();
        (
            json["alert"]["id"].as_str().unwrap().to_owned(),
            json["type"].as_str().unwrap().to_owned(),
        )
    }
}

pub type Answer = dyn Fn(usize, &Seen) -> Response + Send + Sync;

pub struct Receiver {
    pub url: String,
    pub seen: Arc<Mutex<Vec<Seen>>>,
    task: tokio::task::JoinHandle<()>,
}

impl Drop for Receiver {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl Receiver {
    /// Answers the k-th request, from 0, with `answer(k, request)`.
    pub async fn start(answer: impl Fn(usize, &Seen) -> Response + Send + Sync + 'static) -> Self {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
        Self::on(listener, answer)
    }

    pub fn on(
        listener: tokio::net::TcpListener,
        answer: impl Fn(usize, &Seen) -> Response + Send + Sync + 'static,
    ) -> Self {
        let url = format!("http://{}/hook", listener.local_addr().unwrap());
        let seen: Arc<Mutex<Vec<Seen>>> = Arc::default();
        let answer: Arc<Answer> = Arc::new(answer);
        let app = Router::new().fallback(take).with_state((seen.clone(), answer));
        let task = tokio::spawn(async move { axum::serve(listener, app).await.unwrap() });
        Self { url, seen, task }
    }

    pub async fn accepting() -> Self {
        Self::start(|_, _| StatusCode::NO_CONTENT.into_response()).await
    }

    pub fn all(&self) -> Vec<Seen> {
        self.seen.lock().unwrap().clone()
    }

    pub fn accepted(&self) -> Vec<(String, String)> {
        self.all().iter().filter(|s| s.accepted).map(Seen::what).collect()
    }
}

pub async fn take(
    State((seen, answer)): State<(Arc<Mutex<Vec<Seen>>>, Arc<Answer>)>,
    headers: HeaderMap,
    body: Bytes,
) -> Response {
    let text = |(name, value): (&axum::http::HeaderName, &axum::http::HeaderValue)| {
        (name.to_string(), value.to_str().unwrap().to_owned())
    };
    let mut request = Seen {
        headers: headers.iter().map(text).collect(),
        body: body.to_vec(),
        accepted: false,
    };
    let mut seen = seen.lock().unwrap();
    let response = answer(seen.len(), &request);
    request.accepted = response.status().is_success();
    seen.push(request);
    response
}
