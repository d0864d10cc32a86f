//! A server of short texts over HTTP, without threads: a bounded number of connections, one request on each.

use httparse::{EMPTY_HEADER, Request, Status};
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Result, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::time::{Duration, Instant};

/// Maximum number of connections.
const MAX_CONNECTIONS: usize = 32;
/// Maximum number of new connections in one call, so that a flood of them does not occupy the owner.
const MAX_ACCEPTED: usize = 256;
/// Longest time for a request and its response.
const PATIENCE: Duration = Duration::from_secs(10);
/// Maximum length of a request.
const MAX_REQUEST_BYTES: usize = 16 << 10;
/// Maximum number of a request's header lines.
const MAX_HEADERS: usize = 64;

/// Status with its reason phrase, content type and text of a response.
pub(crate) type Response = (&'static str, &'static str, String);

/// A listening server. Its owner calls [`Server::serve`] again and again.
#[derive(Debug)]
pub(crate) struct Server {
    listener: TcpListener,
    max_connections: usize,
    /// Open connections, oldest first.
    connections: VecDeque<Connection>,
}

impl Server {
    pub(crate) fn bind(address: SocketAddr) -> Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self { listener, max_connections: MAX_CONNECTIONS, connections: VecDeque::new() })
    }

    pub(crate) fn address(&self) -> Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves what has arrived, without waiting. `answer` gets method and target of each request.
    pub(crate) fn serve(&mut self, mut answer: impl FnMut(&str, &str) -> Response) {
        self.connections.retain_mut(|connection| connection.advance(&mut answer));
        for _ in 0..MAX_ACCEPTED {
            let accepted = self.listener.accept();
            if accepted.as_ref().is_err_and(|error| error.kind() == ErrorKind::WouldBlock) {
                return;
            }
            // A new connection wins over the oldest, whose client sends nothing. So does an accept that fails, which
            // needs a descriptor.
            if self.connections.len() >= self.max_connections || accepted.is_err() {
                let oldest = self.connections.pop_front();
                if accepted.is_err() && oldest.is_none() {
                    return;
                }
            }
            if let Ok((stream, _)) = accepted
                && stream.set_nonblocking(true).is_ok()
            {
                let mut connection =
                    Connection { stream, opened: Instant::now(), request: Vec::new(), response: VecDeque::new() };
                if connection.advance(&mut answer) {
                    self.connections.push_back(connection);
                }
            }
        }
    }
}

#[derive(Debug)]
struct Connection {
    stream: TcpStream,
    opened: Instant,
    request: Vec<u8>,
    /// The rest of the response; empty until the request is complete.
    response: VecDeque<u8>,
}

impl Connection {
    /// Reads and writes without waiting. Returns true if the connection stays open.
    fn advance(&mut self, answer: &mut impl FnMut(&str, &str) -> Response) -> bool {
        let advanced = if self.response.is_empty() { self.read(answer) } else { Ok(true) };
        let is_open = advanced.and_then(|is_open| if self.response.is_empty() { Ok(is_open) } else { self.write() });
        match is_open {
            Ok(is_open) => is_open && self.opened.elapsed() < PATIENCE,
            Err(error) => error.kind() == ErrorKind::WouldBlock && self.opened.elapsed() < PATIENCE,
        }
    }

    fn read(&mut self, answer: &mut impl FnMut(&str, &str) -> Response) -> Result<bool> {
        let mut bytes = [0; 1024];
        loop {
            let count = self.stream.read(&mut bytes)?;
            self.request.extend(&bytes[..count]);
            let mut headers = [EMPTY_HEADER; MAX_HEADERS];
            let mut request = Request::new(&mut headers);
            let response = match request.parse(&self.request) {
                Ok(Status::Complete(_)) => answer(request.method.unwrap_or_default(), request.path.unwrap_or_default()),
                Ok(Status::Partial) if count == 0 => return Ok(false),
                Ok(Status::Partial) if self.request.len() <= MAX_REQUEST_BYTES => continue,
                _ => ("400 Bad Request", "text/plain", "bad request\n".to_owned()),
            };
            let (status, kind, body) = response;
            let length = body.len();
            let head = format!("HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n");
            self.response = (head + "Connection: close\r\n\r\n" + &body).into_bytes().into();
            return Ok(true);
        }
    }

    fn write(&mut self) -> Result<bool> {
        while !self.response.is_empty() {
            let count = self.stream.write(self.response.as_slices().0)?;
            self.response.drain(..count);
        }
        self.stream.shutdown(std::net::Shutdown::Write)?;
        Ok(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn server(max_connections: usize) -> Server {
        Server { max_connections, ..Server::bind("127.0.0.1:0".parse().unwrap()).unwrap() }
    }

    fn connect(server: &Server, sent: &str) -> TcpStream {
        let mut client = TcpStream::connect(server.address().unwrap()).unwrap();
        client.set_read_timeout(Some(Duration::from_millis(1))).unwrap();
        client.write_all(sent.as_bytes()).unwrap();
        client
    }

    /// Serves until the client has its response.
    fn response(server: &mut Server, mut client: TcpStream) -> String {
        let mut text = String::new();
        let mut bytes = [0; 4096];
        for _ in 0..10_000 {
            server
                .serve(|method, target| ("200 OK", "text/plain", format!("{method} {target} {}", "x".repeat(1 << 20))));
            match client.read(&mut bytes) {
                Ok(0) => return text,
                Ok(count) => text.push_str(std::str::from_utf8(&bytes[..count]).unwrap()),
                Err(error) => assert_eq!(error.kind(), ErrorKind::WouldBlock, "{error}"),
            }
        }
        panic!("no response")
    }

    /// Idle connections, however many, do not keep a request from its response, which may be long.
    #[test]
    fn idle_connections_do_not_lock_others_out() {
        let mut server = server(4);
        let idle: Vec<TcpStream> = (0..40).map(|_| connect(&server, "GET /metrics HTTP/1.1\r\nX-")).collect();
        let client = connect(&server, "GET /metrics?x=1 HTTP/1.1\r\nHost: a\r\n\r\n");
        let text = response(&mut server, client);
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 200 OK\r\n") && head.contains("Content-Length: 1048593"), "{head}");
        assert!(body.starts_with("GET /metrics?x=1 ") && body.len() == 1_048_593);
        assert!(server.connections.len() <= 4);
        drop(idle);
    }

    /// A request may come in pieces. Other bytes and endless headers are refused, and a client may leave at any time.
    #[test]
    fn requests_come_in_any_form() {
        let mut server = server(4);
        let mut client = connect(&server, "GET / HT");
        server.serve(|_, _| unreachable!());
        client.write_all(b"TP/1.0\r\n\r\n").unwrap();
        assert!(response(&mut server, client).starts_with("HTTP/1.1 200"));
        for wrong in ["\0\0\0\0", "\u{16}\u{3}\u{1}", &format!("GET / HTTP/1.1\r\nX: {}", "x".repeat(20_000))] {
            let client = connect(&server, wrong);
            assert!(response(&mut server, client).starts_with("HTTP/1.1 400"), "{wrong:.20}");
        }
        drop(connect(&server, "GET / HTTP/1.1\r\n"));
        drop(connect(&server, "GET / HTTP/1.1\r\n\r\n"));
        let client = connect(&server, "GET /b HTTP/1.1\r\n\r\n");
        assert!(response(&mut server, client).contains("GET /b"));
    }
}
