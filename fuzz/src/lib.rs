//! What is fuzzed. The bodies stand here, so that the main suite can run them on the seeds (`tests/fuzz`).

#[path = "../../tests/api/fake.rs"]
#[allow(dead_code, reason = "the API's own tests use more of it")]
pub mod fake;
pub mod http;
pub mod targets;
