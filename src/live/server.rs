//! An HTTP server for one page. A random token in its address is the key to everything; who lacks it learns nothing.

use std::convert::Infallible;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{
    CACHE_CONTROL, CONNECTION, CONTENT_SECURITY_POLICY, CONTENT_TYPE, HeaderName, HeaderValue,
    REFERRER_POLICY, X_CONTENT_TYPE_OPTIONS, X_FRAME_OPTIONS,
};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response};
use hyper_util::rt::{TokioIo, TokioTimer};
use nightsplat_core::hash;
use tokio::net::TcpStream;
use tokio::sync::oneshot;
use tokio::task::AbortHandle;

use super::listen::Listen;
use super::site::{Answer, Site};
use crate::{Error, Result};

/// The most connections at a time. One more takes the place of the first that has not shown the token within
/// [`TOKEN_WITHIN`], or is closed at once.
const CONNECTIONS: usize = 64;
const TOKEN_WITHIN: Duration = Duration::from_secs(2);
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
pub(crate) struct Server {
    address: SocketAddr,
    token: String,
    stop: Option<oneshot::Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts to listen. Port 0 is any free one.
    pub(crate) fn start(Listen(asked): Listen, site: Arc<Site>) -> Result<Self> {
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

    /// The address of the page: that of this machine, if it listens on all.
    pub(crate) fn url(&self) -> String {
        let mut address = self.address;
        if address.ip().is_unspecified() {
            address.set_ip(own_address(address.is_ipv6()));
        }
        format!("http://{address}/{}/", self.token)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // The thread may have ended already.
        let _ = self.stop.take().map(|stop| stop.send(()));
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// The address under which others reach this machine, or only itself without a network. Nothing is sent.
fn own_address(is_v6: bool) -> IpAddr {
    let (any, far) = match is_v6 {
        true => ("[::]:0", "[2001:db8::1]:9"),
        false => ("0.0.0.0:0", "192.0.2.1:9"),
    };
    let towards_far = || {
        let socket = UdpSocket::bind(any)?;
        socket.connect(far)?;
        Ok::<_, std::io::Error>(socket.local_addr()?.ip())
    };
    let loopback = if is_v6 { Ipv6Addr::LOCALHOST.into() } else { Ipv4Addr::LOCALHOST.into() };
    towards_far().ok().filter(|ip| !ip.is_unspecified()).unwrap_or(loopback)
}

/// 128 random bits.
fn token() -> Result<String> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)
        .map_err(|error| Error::input("random numbers", format!("of the system: {error}")))?;
    Ok(hash::hexadecimal(&bytes))
}

/// A connection that is served.
struct Connection {
    task: AbortHandle,
    begin: Instant,
    /// Whether a request had the token.
    is_known: Arc<AtomicBool>,
}

impl Connection {
    fn yields(&self) -> bool {
        !self.is_known.load(Ordering::Relaxed) && self.begin.elapsed() >= TOKEN_WITHIN
    }
}

async fn accept(listener: TcpListener, prefix: String, site: Arc<Site>) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
    let (prefix, mut open) = (Arc::<str>::from(prefix), Vec::<Connection>::new());
    loop {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(AFTER_REFUSAL).await;
            continue;
        };
        open.retain(|connection| !connection.task.is_finished());
        if open.len() >= CONNECTIONS {
            let Some(first) = open.iter().position(Connection::yields) else { continue };
            open.remove(first).task.abort();
        }
        let is_known = Arc::new(AtomicBool::new(false));
        let serving = serve(stream, Arc::clone(&prefix), Arc::clone(&site), Arc::clone(&is_known));
        let task = tokio::spawn(serving).abort_handle();
        open.push(Connection { task, begin: Instant::now(), is_known });
    }
}

/// Answers the requests of one connection. The first without the token is its last.
async fn serve(stream: TcpStream, prefix: Arc<str>, site: Arc<Site>, is_known: Arc<AtomicBool>) {
    let answer = move |request: Request<Incoming>| {
        let (prefix, site) = (Arc::clone(&prefix), Arc::clone(&site));
        let is_known = Arc::clone(&is_known);
        async move {
            let Some(path) = within(request.uri().path(), &prefix) else {
                let mut response = response(Answer::NOT_FOUND);
                response.headers_mut().insert(CONNECTION, HeaderValue::from_static("close"));
                return Ok::<_, Infallible>(response);
            };
            is_known.store(true, Ordering::Relaxed);
            Ok(response(answer(request.method().clone(), path.to_owned(), site).await))
        }
    };
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEADERS_WITHIN)
        .max_buf_size(LONGEST_HEAD)
        .serve_connection(TokioIo::new(stream), service_fn(answer));
    // A client that breaks off or breaks the protocol is no concern of ours.
    let _ = tokio::time::timeout(CONNECTION_WITHIN, serving).await;
}

async fn answer(method: Method, path: String, site: Arc<Site>) -> Answer {
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

#[cfg(test)]
mod tests {
    use std::io::{Read, Write};

    use super::*;
    use crate::live::Feed;
    use nightsplat_models::gaussians::Gaussians;

    fn server() -> Server {
        let feed = Feed::of_gaussians(&Gaussians::zeros(1, 0));
        let site = Site { html: "the page".into(), feed, pictures: None };
        Server::start("127.0.0.1:0".parse().unwrap(), Arc::new(site)).unwrap()
    }

    fn connected(server: &Server) -> std::net::TcpStream {
        let stream = std::net::TcpStream::connect(server.address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        stream
    }

    fn ask(stream: &mut std::net::TcpStream, path: &str) -> std::io::Result<()> {
        stream.write_all(format!("GET {path} HTTP/1.1\r\nHost: x\r\n\r\n").as_bytes())
    }

    /// The answer to a request that keeps the connection; empty if the server closed it.
    fn answer(stream: &mut std::net::TcpStream, path: &str) -> String {
        let mut bytes = vec![0; 4096];
        let read = ask(stream, path).and_then(|()| stream.read(&mut bytes)).unwrap_or_default();
        String::from_utf8_lossy(&bytes[..read]).into_owned()
    }

    #[test]
    fn a_wrong_token_ends_its_connection_and_the_right_one_keeps_it() {
        let server = server();
        let mut stream = connected(&server);
        for path in ["", "state", "no such path"] {
            let path = format!("/{}/{path}", server.token).replace(' ', "");
            assert!(answer(&mut stream, &path).starts_with("HTTP/1.1 "), "{path}");
        }
        ask(&mut stream, "/state").unwrap();
        let mut refused = String::new();
        stream.read_to_string(&mut refused).unwrap();
        assert!(refused.starts_with("HTTP/1.1 404") && refused.contains("connection: close"));
    }

    #[test]
    fn connections_without_the_token_do_not_lock_out_one_with_it() {
        let server = server();
        let page = format!("/{}/", server.token);
        let mut owner = connected(&server);
        assert!(answer(&mut owner, &page).contains("the page"));
        let _held: Vec<_> = (0..CONNECTIONS).map(|_| connected(&server)).collect();
        assert_eq!(answer(&mut connected(&server), &page), "", "all places are taken");
        std::thread::sleep(TOKEN_WITHIN);
        for _ in 0..3 {
            assert!(answer(&mut connected(&server), &page).contains("the page"));
        }
        assert!(answer(&mut owner, &page).contains("the page"), "who is known stays");
    }
}
