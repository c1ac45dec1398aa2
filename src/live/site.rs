//! What the live page consists of.

use std::sync::{Mutex, PoisonError};

use hyper::body::Bytes;
use hyper::{Method, StatusCode};

use super::feed::Feed;
use super::pictures::Pictures;

/// The page, and what it asks for.
#[derive(Debug)]
pub(crate) struct Site {
    pub(crate) html: Bytes,
    pub(crate) feed: Feed,
    /// Of the dataset, if there is one. One image is made at a time.
    pub(crate) pictures: Option<Mutex<Pictures>>,
}

/// The answer to a request.
#[derive(Clone, Debug)]
pub(super) struct Answer {
    pub(super) status: StatusCode,
    /// The media type.
    pub(super) kind: &'static str,
    pub(super) body: Bytes,
}

impl Answer {
    pub(super) const NOT_FOUND: Self = Self::text(StatusCode::NOT_FOUND, "not found\n");
    pub(super) const FAILED: Self = Self::text(StatusCode::INTERNAL_SERVER_ERROR, "failed\n");

    const fn text(status: StatusCode, text: &'static str) -> Self {
        Self {
            status,
            kind: "text/plain; charset=utf-8",
            body: Bytes::from_static(text.as_bytes()),
        }
    }

    const fn ok(kind: &'static str, body: Bytes) -> Self {
        Self { status: StatusCode::OK, kind, body }
    }
}

impl Site {
    /// The answer to a request for a path below the token:
    ///
    /// | path | answer |
    /// |---|---|
    /// | | the page |
    /// | `state` | the progress, as JSON |
    /// | `model` | the model, as the viewer reads it |
    /// | `file` | the file of the model, whole, as it was saved last |
    /// | `picture/VIEW/KIND` | a photograph, target or reference image, as JPEG |
    /// | `do/WHAT` (POST) | pause, resume, save, finish or stop |
    pub(super) fn answer(&self, method: &Method, path: &str) -> Answer {
        let parts: Vec<&str> = path.split('/').collect();
        match (method.as_str(), &parts[..]) {
            ("GET", [""]) => Answer::ok("text/html; charset=utf-8", self.html.clone()),
            ("GET", ["state"]) => {
                Answer::ok("application/json", self.feed.state().to_string().into())
            }
            ("GET", ["model"]) => match self.feed.model() {
                Some(model) => Answer::ok("application/octet-stream", model),
                None => Answer::NOT_FOUND,
            },
            ("GET", ["file"]) => match self.feed.saved() {
                Some(file) => Answer::ok("application/octet-stream", file),
                None => Answer::NOT_FOUND,
            },
            ("GET", ["picture", view, kind]) => self.picture(view, kind),
            ("POST", ["do", what]) if self.feed.follow(what) => {
                Answer::text(StatusCode::OK, "requested\n")
            }
            _ => Answer::NOT_FOUND,
        }
    }

    fn picture(&self, view: &str, kind: &str) -> Answer {
        let (Ok(view), Some(pictures)) = (view.parse(), &self.pictures) else {
            return Answer::NOT_FOUND;
        };
        let mut pictures = pictures.lock().unwrap_or_else(PoisonError::into_inner);
        match pictures.jpeg(view, kind) {
            Ok(Some(jpeg)) => Answer::ok("image/jpeg", jpeg),
            Ok(None) => Answer::NOT_FOUND,
            Err(error) => {
                tracing::warn!("the live page lacks an image: {error}");
                Answer::FAILED
            }
        }
    }
}
