//! Inline images: the protocols of terminals, and the detection of the terminal's protocol.

use anyhow::Context;
use base64::prelude::{BASE64_STANDARD, Engine as _};
use clap::ValueEnum;
use color_quant::NeuQuant;
use image::codecs::png::PngEncoder;
use image::imageops::{FilterType, resize};
use image::{ExtendedColorType, ImageEncoder as _, RgbImage};
use ratatui::crossterm::terminal;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{IsTerminal as _, Read as _, Write as _};
use std::time::{Duration, Instant};

/// Maximum width of an image, columns.
const MAX_COLUMNS: u32 = 80;
/// Width of a column for protocols with pixels.
const COLUMN_PX: u32 = 8;
/// Largest enlargement of such an image, so that a small image does not fill the screen.
const MAX_SCALE: u32 = 3;
/// Longest time to wait for the terminal's answer.
const ANSWER: Duration = Duration::from_millis(300);
/// Maximum length of the answer, bytes.
const MAX_ANSWER_BYTES: usize = 256;
/// Maximum length of one part of an encoded image in kitty's protocol, bytes.
const KITTY_CHUNK_BYTES: usize = 4096;
/// Number of colours of a sixel image.
const SIXEL_COLOURS: usize = 256;

/// A protocol for images in a terminal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum Inline {
    /// The best protocol that the terminal supports.
    #[default]
    Auto,
    /// Kitty's graphics protocol: kitty, Ghostty, Konsole.
    Kitty,
    /// iTerm2's inline images: iTerm2, wezterm.
    Iterm,
    /// Sixels, in 256 colours: foot, xterm, mlterm, Windows Terminal.
    Sixel,
    /// Half blocks: any terminal with 24-bit colours.
    Blocks,
}

impl Inline {
    /// Resolves `Auto` by asking the terminal. Call this before anything else reads from the terminal.
    pub(crate) fn resolved(self) -> Self {
        match self {
            Self::Auto => {
                let said = from_environment(|name| std::env::var(name).ok());
                said.unwrap_or_else(|| if says_sixel() { Self::Sixel } else { Self::Blocks })
            }
            chosen => chosen,
        }
    }

    /// Encodes an image, RGB bytes row by row, for a terminal with this number of columns. The text ends at the start
    /// of the next line.
    pub(crate) fn encode(self, rgb: &[u8], [width_px, height_px]: [u32; 2], columns: u32) -> anyhow::Result<String> {
        let drawn_columns = columns.min((width_px * MAX_SCALE).div_ceil(COLUMN_PX)).max(1);
        Ok(match self {
            Self::Kitty => in_kitty(&png(rgb, [width_px, height_px])?, drawn_columns),
            Self::Iterm => in_iterm(&png(rgb, [width_px, height_px])?, drawn_columns),
            Self::Sixel => {
                let image = RgbImage::from_raw(width_px, height_px, rgb.to_vec()).context("no image")?;
                let wide_px = drawn_columns * COLUMN_PX;
                let high_px = (height_px * wide_px / width_px.max(1)).max(1);
                in_sixels(&resize(&image, wide_px, high_px, FilterType::Triangle))
            }
            Self::Auto | Self::Blocks => in_blocks(rgb, [width_px, height_px], columns.clamp(1, width_px.max(1))),
        })
    }
}

/// Returns the space for an image, columns.
pub(crate) fn columns() -> u32 {
    let wide = if std::io::stdout().is_terminal() { terminal::size().ok() } else { None };
    // Some terminals report 0 for an unknown width.
    wide.map(|(columns, _)| columns.into())
        .filter(|&columns| columns > 0)
        .map_or(MAX_COLUMNS, |c: u32| c.min(MAX_COLUMNS))
}

/// Returns the protocol by environment variables; `None` if the terminal must be asked.
fn from_environment(variable: impl Fn(&str) -> Option<String>) -> Option<Inline> {
    let holds = |name: &str, words: &[&str]| variable(name).is_some_and(|v| words.iter().any(|word| v.contains(word)));
    // Inside a multiplexer the variables describe the outer terminal, which does not receive this output.
    if holds("TERM", &["tmux", "screen"]) || variable("TMUX").is_some() {
        return None;
    }
    if variable("KITTY_WINDOW_ID").is_some()
        || holds("TERM", &["kitty", "ghostty"])
        || holds("TERM_PROGRAM", &["ghostty"])
    {
        return Some(Inline::Kitty);
    }
    // ssh forwards the second variable to other machines.
    (holds("TERM_PROGRAM", &["iTerm", "WezTerm"]) || holds("LC_TERMINAL", &["iTerm"])).then_some(Inline::Iterm)
}

/// Asks the terminal for its attributes, and returns true if they include sixels.
fn says_sixel() -> bool {
    attributes().is_ok_and(|answer| has_sixel(&answer))
}

/// Returns true for an answer `ESC [ ? a ; b ; ... c` that contains 4, the number of sixels.
fn has_sixel(answer: &[u8]) -> bool {
    let answer = String::from_utf8_lossy(answer);
    let attributes = answer.split_once("\x1b[?").and_then(|(_, rest)| rest.split_once('c'));
    attributes.is_some_and(|(list, _)| list.split(';').any(|attribute| attribute == "4"))
}

/// Asks the terminal for its attributes, and returns its answer within the time limit.
fn attributes() -> std::io::Result<Vec<u8>> {
    let mut tty = File::options().read(true).write(true).open("/dev/tty")?;
    // Otherwise the answer would appear on the screen, and be delayed until the end of the line.
    terminal::enable_raw_mode()?;
    let mut answer = Vec::new();
    let result = (|| {
        tty.write_all(b"\x1b[c")?;
        let deadline = Instant::now() + ANSWER;
        while answer.last() != Some(&b'c') && answer.len() < MAX_ANSWER_BYTES {
            let left = deadline.saturating_duration_since(Instant::now());
            let left = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
            if poll(&mut [PollFd::new(&tty, PollFlags::IN)], Some(&left))? == 0 {
                break;
            }
            let mut bytes = [0; 64];
            let read = tty.read(&mut bytes)?;
            if read == 0 {
                break;
            }
            answer.extend_from_slice(&bytes[..read]);
        }
        Ok(())
    })();
    terminal::disable_raw_mode()?;
    result.map(|()| answer)
}

fn png(rgb: &[u8], [width_px, height_px]: [u32; 2]) -> anyhow::Result<Vec<u8>> {
    let mut png = Vec::new();
    PngEncoder::new(&mut png)
        .write_image(rgb, width_px, height_px, ExtendedColorType::Rgb8)
        .context("cannot encode the image")?;
    Ok(png)
}

/// Encodes a PNG for kitty, shown over these columns without an answer:
/// <https://sw.kovidgoyal.net/kitty/graphics-protocol/>
fn in_kitty(png: &[u8], columns: u32) -> String {
    let data = BASE64_STANDARD.encode(png);
    let (mut text, mut rest) = (String::new(), data.as_str());
    let mut what = format!("a=T,f=100,c={columns},");
    while !rest.is_empty() {
        let (chunk, after) = rest.split_at(rest.len().min(KITTY_CHUNK_BYTES));
        let _ = write!(text, "\x1b_G{what}q=2,m={};{chunk}\x1b\\", u8::from(!after.is_empty()));
        what.clear();
        rest = after;
    }
    text + "\n"
}

/// Encodes a PNG for iTerm2: <https://iterm2.com/documentation-images.html>
fn in_iterm(png: &[u8], columns: u32) -> String {
    let data = BASE64_STANDARD.encode(png);
    let size = png.len();
    format!("\x1b]1337;File=inline=1;size={size};width={columns};preserveAspectRatio=1:{data}\x07\n")
}

/// Encodes sixels: six rows at a time, one colour after another. Each character is a column of six pixels, with a bit
/// for each pixel of the colour. <https://vt100.net/docs/vt3xx-gp/chapter14.html>
fn in_sixels(image: &RgbImage) -> String {
    let rgba: Vec<u8> = image.pixels().flat_map(|p| [p[0], p[1], p[2], u8::MAX]).collect();
    let palette = NeuQuant::new(1, SIXEL_COLOURS, &rgba);
    let indices: Vec<usize> = rgba.chunks_exact(4).map(|pixel| palette.index_of(pixel)).collect();
    let (width, height) = (image.width() as usize, image.height());
    let mut text = format!("\x1bP0;1q\"1;1;{width};{height}");
    for (index, colour) in palette.color_map_rgb().chunks_exact(3).enumerate() {
        let [r, g, b] = [colour[0], colour[1], colour[2]].map(|part| (u32::from(part) * 100 + 127) / 255);
        let _ = write!(text, "#{index};2;{r};{g};{b}");
    }
    for band in indices.chunks(width * 6) {
        let mut columns = vec![Vec::new(); SIXEL_COLOURS];
        for (at, &index) in band.iter().enumerate() {
            let of_colour = &mut columns[index];
            of_colour.resize(width, 0_u8);
            of_colour[at % width] |= 1 << (at / width);
        }
        for (index, columns) in columns.iter().enumerate().filter(|(_, columns)| !columns.is_empty()) {
            let _ = write!(text, "#{index}");
            for run in columns.chunk_by(|a, b| a == b) {
                let six = char::from(b'?' + run[0]);
                match run.len() {
                    1..=3 => text.extend(std::iter::repeat_n(six, run.len())),
                    length => drop(write!(text, "!{length}{six}")),
                }
            }
            text.push('$');
        }
        text.push('-');
    }
    text + "\x1b\\\n"
}

/// Encodes half blocks: each character is two pixels, one above the other.
fn in_blocks(rgb: &[u8], [width_px, height_px]: [u32; 2], columns: u32) -> String {
    let rows = (height_px * columns / width_px.max(1)).max(1);
    let pixel = |column: u32, row: u32| {
        let (x, y) = (column * width_px / columns, (row * height_px / rows).min(height_px.saturating_sub(1)));
        let at = ((y * width_px + x) * 3) as usize;
        rgb.get(at..at + 3).map_or([0; 3], |p| [p[0], p[1], p[2]])
    };
    let mut text = String::new();
    for row in (0..rows).step_by(2) {
        for column in 0..columns {
            let ([r, g, b], [br, bg, bb]) = (pixel(column, row), pixel(column, row + 1));
            let _ = write!(text, "\x1b[38;2;{r};{g};{b}m\x1b[48;2;{br};{bg};{bb}m\u{2580}");
        }
        text += "\x1b[0m\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE_PX: [u32; 2] = [61, 40];

    /// Returns noise over a gradient: long when compressed, and with more colours than a palette.
    fn image() -> Vec<u8> {
        let [width_px, height_px] = SIZE_PX;
        let pixel = |x: u32, y: u32| [x * 4, y * 6, (x * 7919 + y * 104_729) % 97].map(|part| part as u8);
        (0..height_px).flat_map(|y| (0..width_px).flat_map(move |x| pixel(x, y))).collect()
    }

    fn pixels_of(png: &[u8]) -> (Vec<u8>, [u32; 2]) {
        let image = image::load_from_memory_with_format(png, image::ImageFormat::Png).unwrap().into_rgb8();
        let size_px = [image.width(), image.height()];
        (image.into_raw(), size_px)
    }

    /// The output for kitty decodes to the image, bit for bit. Parts have at most the maximum length, all but the last
    /// announce more, and only the first has the display options.
    #[test]
    fn kitty_is_sent_the_image() {
        let text = Inline::Kitty.encode(&image(), SIZE_PX, 80).unwrap();
        let parts: Vec<&str> = text.strip_suffix("\x1b\\\n").unwrap().split("\x1b\\").collect();
        assert!(parts.len() > 1, "{}", text.len());
        let mut data = String::new();
        for (number, part) in parts.iter().enumerate() {
            let (keys, chunk) = part.strip_prefix("\x1b_G").unwrap().split_once(';').unwrap();
            let more = u8::from(number + 1 < parts.len());
            let expected = if number == 0 { "a=T,f=100,c=23," } else { "" };
            assert_eq!(keys, format!("{expected}q=2,m={more}"));
            assert!(chunk.len() <= 4096 && (more == 0 || chunk.len() % 4 == 0), "{}", chunk.len());
            data += chunk;
        }
        assert_eq!(pixels_of(&BASE64_STANDARD.decode(data).unwrap()), (image(), SIZE_PX));
    }

    /// The output for iTerm2 decodes to the image, bit for bit, and contains its size in bytes.
    #[test]
    fn iterm_is_sent_the_image() {
        let text = Inline::Iterm.encode(&image(), SIZE_PX, 80).unwrap();
        let text = text.strip_prefix("\x1b]1337;File=").unwrap().strip_suffix("\x07\n").unwrap();
        let (keys, data) = text.split_once(':').unwrap();
        let png = BASE64_STANDARD.decode(data).unwrap();
        assert_eq!(keys, format!("inline=1;size={};width=23;preserveAspectRatio=1", png.len()));
        assert_eq!(pixels_of(&png), (image(), SIZE_PX));
    }

    /// Decodes sixels like a terminal: colours in hundredths, repeats, returns and new bands.
    fn drawn(text: &str) -> RgbImage {
        let body = text.strip_prefix("\x1bP0;1q\"").unwrap().strip_suffix("\x1b\\\n").unwrap();
        let mut bytes = body.bytes().peekable();
        let numbers = |bytes: &mut std::iter::Peekable<std::str::Bytes<'_>>| {
            let mut list = vec![0_u32];
            while let Some(byte) = bytes.next_if(|b| b.is_ascii_digit() || *b == b';') {
                match (byte, list.last_mut()) {
                    (b';', _) => list.push(0),
                    (digit, Some(last)) => *last = *last * 10 + u32::from(digit - b'0'),
                    (_, None) => {}
                }
            }
            list
        };
        let [1, 1, width, height] = numbers(&mut bytes)[..] else { panic!("no raster attributes") };
        let mut image = RgbImage::new(width, height);
        let mut painted = vec![false; (width * height) as usize];
        let mut palette = vec![[0; 3]; 256];
        let (mut x, mut y, mut colour, mut repeat) = (0, 0, 0, 1);
        while let Some(byte) = bytes.next() {
            match byte {
                b'#' => match numbers(&mut bytes)[..] {
                    [index, 2, r, g, b] => palette[index as usize] = [r, g, b].map(|part| (part * 255 / 100) as u8),
                    [index] => colour = index as usize,
                    _ => panic!("no colour"),
                },
                b'!' => repeat = numbers(&mut bytes)[0],
                b'$' => x = 0,
                b'-' => (x, y) = (0, y + 6),
                six => {
                    let bits = six.checked_sub(b'?').filter(|bits| *bits < 64).expect("a sixel");
                    for _ in 0..std::mem::replace(&mut repeat, 1) {
                        for row in (0..6).filter(|row| bits & (1 << row) != 0) {
                            image.put_pixel(x, y + row, image::Rgb(palette[colour]));
                            let was = std::mem::replace(&mut painted[((y + row) * width + x) as usize], true);
                            assert!(!was, "pixel {x}, {} twice", y + row);
                        }
                        x += 1;
                    }
                }
            }
        }
        assert!(painted.iter().all(|&pixel| pixel), "all pixels are painted");
        image
    }

    /// Sixels paint every pixel once, in a colour close to the image's.
    #[test]
    fn sixels_paint_the_image() {
        let image = RgbImage::from_raw(SIZE_PX[0], SIZE_PX[1], image()).unwrap();
        let drawn = drawn(&in_sixels(&image));
        let off: u64 = drawn.iter().zip(image.iter()).map(|(&a, &b)| u64::from(a.abs_diff(b))).sum();
        assert!(off / drawn.len() as u64 <= 12, "{} of 255 on average", off / drawn.len() as u64);
        // In a terminal of 20 columns.
        let text = Inline::Sixel.encode(image.as_raw(), SIZE_PX, 20).unwrap();
        assert!(text.starts_with("\x1bP0;1q\"1;1;160;104#"), "{}", &text[..40]);
    }

    /// An image of two rows is one line of blocks, the upper pixel before the lower; wide images are reduced.
    #[test]
    fn two_pixels_make_a_block() {
        let text = Inline::Blocks.encode(&[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12], [2, 2], 80).unwrap();
        assert_eq!(text.lines().count(), 1);
        assert!(text.starts_with("\x1b[38;2;1;2;3m\x1b[48;2;7;8;9m\u{2580}"), "{text:?}");
        assert_eq!(in_blocks(&vec![0; 200 * 100 * 3], [200, 100], 80).lines().count(), 20);
    }

    /// Environment variables identify terminals; inside a multiplexer the terminal must be asked.
    #[test]
    fn terminals_say_what_they_can() {
        let found = |variables: &[(&str, &str)]| {
            from_environment(|name| variables.iter().find(|(n, _)| *n == name).map(|(_, value)| (*value).to_owned()))
        };
        assert_eq!(found(&[("TERM", "xterm-kitty")]), Some(Inline::Kitty));
        assert_eq!(found(&[("TERM", "xterm-256color"), ("KITTY_WINDOW_ID", "1")]), Some(Inline::Kitty));
        assert_eq!(found(&[("TERM", "xterm-ghostty"), ("TERM_PROGRAM", "ghostty")]), Some(Inline::Kitty));
        assert_eq!(found(&[("TERM", "xterm-256color"), ("TERM_PROGRAM", "iTerm.app")]), Some(Inline::Iterm));
        assert_eq!(found(&[("TERM", "xterm-256color"), ("LC_TERMINAL", "iTerm2")]), Some(Inline::Iterm));
        assert_eq!(found(&[("TERM", "xterm-256color"), ("TERM_PROGRAM", "WezTerm")]), Some(Inline::Iterm));
        assert_eq!(found(&[("TERM", "xterm-256color")]), None);
        assert_eq!(found(&[("TERM", "tmux-256color"), ("KITTY_WINDOW_ID", "1")]), None);
        assert_eq!(found(&[("TERM", "xterm-256color"), ("TMUX", "x"), ("TERM_PROGRAM", "iTerm.app")]), None);
        for (answer, expected) in [
            ("\x1b[?62;4;22c", true),
            ("\x1b[?4c", true),
            ("\x1b[?64;1;2;14c", false),
            ("\x1b[?1;2c", false),
            ("", false),
        ] {
            assert_eq!(has_sixel(answer.as_bytes()), expected, "{answer:?}");
        }
    }
}
