//! The API from outside, over real connections.

mod fake;
mod rest;
