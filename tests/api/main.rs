//! The API from outside, over real connections.

mod fake;
mod guards;
mod rest;
mod stream;
