//! An HTTP server for one page. A random token in its address is the key to everything; who lacks it learns nothing.

use std::convert::Infallible;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue, REFERRER_POLICY,
    X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Request, Response};
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::TcpStream;
use tokio::sync::{Semaphore, oneshot};

use super::listen::Listen;
use super::site::{Answer, Site};
use crate::base::hash;
use crate::{Error, Result};

/// The most connections at a time; others are closed at once.
const CONNECTIONS: usize = 64;
/// The most threads that read files and compute images.
const WORKERS: usize = 2;
/// A client that sends its headers more slowly is cut off.
const HEADERS_WITHIN: Duration = Duration::from_secs(10);
/// The longest life of a connection; browsers open another. Bounds the time that a slow reader holds memory.
const CONNECTION_WITHIN: Duration = Duration::from_secs(300);
/// The longest head of a request, in bytes.
const LONGEST_HEAD: usize = 16 << 10;
/// The pause after the system refuses a connection.
const AFTER_REFUSAL: Duration = Duration::from_millis(100);

/// What a browser may do with the page: run its own scripts, and ask this server.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; worker-src blob:; style-src 'unsafe-inline'; \
                      img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'";

const HEADERS: [(HeaderName, &str); 5] = [
    (CACHE_CONTROL, "no-store"),
    (CONTENT_SECURITY_POLICY, POLICY),
    (REFERRER_POLICY, "no-referrer"),
    (X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (X_FRAME_OPTIONS, "DENY"),
];

/// A server on its own thread, until it is dropped.
#[derive(Debug)]
pub(in crate::cli) struct Server {
    address: SocketAddr,
    token: String,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts to listen. Port 0 is any free one.
    pub(in crate::cli) fn start(Listen(asked): Listen, site: Arc<Site>) -> Result<Self> {
        let unusable = |error: std::io::Error| {
            let problem = match error.kind() {
                std::io::ErrorKind::AddrInUse => "is in use; name another port".to_owned(),
                _ => format!("cannot be listened on ({error}); name another"),
            };
            Error::Usage(format!(
                "the address {asked} {problem}, such as 127.0.0.1:0 for any free port"
            ))
        };
        let listener = TcpListener::bind(asked).map_err(unusable)?;
        listener.set_nonblocking(true).map_err(unusable)?;
        let address = listener.local_addr().map_err(unusable)?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .max_blocking_threads(WORKERS)
            .build()
            .map_err(unusable)?;
        let token = token()?;
        let (stop, stopped) = oneshot::channel();
        let prefix = format!("/{token}/");
        let thread = std::thread::Builder::new().name("live page".to_owned());
        let thread = thread
            .spawn(move || {
                runtime.block_on(async {
                    tokio::spawn(accept(listener, prefix, site));
                    // An error means that the sender is gone, which ends the server as well.
                    let _ = stopped.await;
                });
                runtime.shutdown_background();
            })
            .map_err(unusable)?;
        if !address.ip().is_loopback() {
            tracing::warn!(
                "{address} is not encrypted: anyone who learns the address of the page can see the photographs"
            );
        }
        Ok(Self { address, token, stop: Some(stop), thread: Some(thread) })
    }

    /// The address of the page.
    pub(in crate::cli) fn url(&self) -> String {
        format!("http://{}/{}/", self.address, self.token)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // The thread may have ended already.
        let _ = self.stop.take().map(|stop| stop.send(()));
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// 128 random bits.
fn token() -> Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::input("random numbers", format!("of the system: {error}")))?;
    Ok(hash::hexadecimal(&bytes))
}

async fn accept(listener: TcpListener, prefix: String, site: Arc<Site>) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
    let (free, prefix) = (Arc::new(Semaphore::new(CONNECTIONS)), Arc::<str>::from(prefix));
    loop {
        match (listener.accept().await, Arc::clone(&free).try_acquire_owned()) {
            (Ok((stream, _)), Ok(permit)) => {
                let (prefix, site) = (Arc::clone(&prefix), Arc::clone(&site));
                tokio::spawn(async move {
                    serve(stream, prefix, site).await;
                    drop(permit);
                });
            }
            (Ok((stream, _)), Err(_)) => drop(stream),
            (Err(_), _) => tokio::time::sleep(AFTER_REFUSAL).await,
        }
    }
}

/// Answers the requests of one connection.
async fn serve(stream: TcpStream, prefix: Arc<str>, site: Arc<Site>) {
    let answer = move |request: Request<Incoming>| {
        let (prefix, site) = (Arc::clone(&prefix), Arc::clone(&site));
        async move { Ok::<_, Infallible>(response(answer(&request, &prefix, site).await)) }
    };
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS_WITHIN)
        .max_buf_size(LONGEST_HEAD)
        .serve_connection(TokioIo::new(stream), service_fn(answer));
    // A client that breaks off or breaks the protocol is no concern of ours.
    let _ = tokio::time::timeout(CONNECTION_WITHIN, serving).await;
}

async fn answer(request: &Request<Incoming>, prefix: &str, site: Arc<Site>) -> Answer {
    let Some(path) = within(request.uri().path(), prefix) else { return Answer::NOT_FOUND };
    let (method, path) = (request.method().clone(), path.to_owned());
    let answer = tokio::task::spawn_blocking(move || site.answer(&method, &path)).await;
    answer.unwrap_or(Answer::FAILED)
}

/// The path after the prefix with the token, compared in a time that does not depend on the guess.
fn within<'a>(path: &'a str, prefix: &str) -> Option<&'a str> {
    let (head, rest) = path.split_at_checked(prefix.len())?;
    let differs = head.bytes().zip(prefix.bytes()).fold(0, |differs, (a, b)| differs | (a ^ b));
    (differs == 0).then_some(rest)
}

fn response(Answer { status, kind, body }: Answer) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(body));
    *response.status_mut() = status;
    let headers = response.headers_mut();
    headers.insert(CONTENT_TYPE, HeaderValue::from_static(kind));
    for (name, value) in HEADERS {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}
