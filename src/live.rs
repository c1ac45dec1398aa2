//! The live page: what `view` and `train --view` serve to a browser.
//!
//! A `Feed` knows the model and the progress of its training, `Pictures` makes images of the dataset's views, and a
//! `Server` answers requests for both.

mod feed;
mod listen;
mod pictures;
mod server;
mod site;

pub(crate) use self::feed::Feed;
pub use self::listen::{DEFAULT_ADDRESS, Listen};
pub(crate) use self::pictures::Pictures;
pub(crate) use self::server::Server;
pub(crate) use self::site::Site;
