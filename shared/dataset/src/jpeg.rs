//! Completeness of JPEG files.
//!
//! A decoder reports no error for a file without its last part, and fills the missing part of the image with grey.

/// Bytes that the decoder reads if the image data ends too early, in two forms that differ in the first bit. In most
/// code tables they are many short codes; none is a marker.
const FILLS: [&[u8]; 2] = [&[0xA4, 0x92, 0x49, 0x52, 0x25], &[0x5B, 0xA7, 0x69, 0x3E, 0x14, 0xC2]];
/// Repetitions of each form: enough to reach each component of a coded unit.
const FILL_TIMES: usize = 8;
/// Reason for a file without its last bytes.
const NO_END: &str = "the file is cut off: it has no end marker; copy or export it again";
/// Reason for a file whose image data is followed by an end marker too early.
pub(crate) const NO_DATA: &str = "the file is cut off: image data is missing before its end marker; export it again";

/// Finds the end marker of a JPEG file; returns its position.
///
/// # Errors
///
/// Returns the reason if the file has no end marker, or ends before a part of its image data. A part that ends too early
/// is not found: see [`filled`].
pub(crate) fn end_of_whole(bytes: &[u8]) -> Result<usize, &'static str> {
    let mut layout = Layout::default();
    let mut at = 2;
    while let Some(&[marker, code]) = bytes.get(at..at + 2) {
        at += match (marker, code) {
            (0xFF, 0xD9) => return if layout.is_whole() { Ok(at) } else { Err(NO_DATA) },
            // Image data: bytes, stuffed bytes, restart markers, fill bytes.
            (..0xFF, _) | (0xFF, 0xFF) => 1,
            (0xFF, 0x00 | 0x01 | 0xD8) => 2,
            (0xFF, 0xD0..=0xD7) => {
                layout.restarts_left = layout.restarts_left.saturating_sub(1);
                2
            }
            // Segments have a length, and may contain a preview with an end marker of its own.
            (0xFF, _) => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { return Err(NO_END) };
                let length = usize::from(u16::from_be_bytes([high, low]));
                layout.read(code, bytes.get(at + 4..at + 2 + length).unwrap_or_default())?;
                2 + length
            }
        };
    }
    Err(NO_END)
}

/// Returns the file in two forms, with other bytes in place of image data that is missing before the end marker. Both
/// show the same image only if no data is missing.
pub(crate) fn filled(bytes: &[u8], end: usize) -> [Vec<u8>; 2] {
    let (data, rest) = bytes.split_at(end.min(bytes.len()));
    FILLS.map(|fill| [data, &fill.repeat(FILL_TIMES), rest].concat())
}

/// A colour component of the image.
#[derive(Debug)]
struct Component {
    id: u8,
    /// Blocks of 8x8 samples across and down in an interleaved unit.
    blocks: [usize; 2],
    /// True for each coefficient whose last bit a scan has coded.
    coded: [bool; 64],
}

/// Description of the image data, from the segments of a file.
#[derive(Debug, Default)]
struct Layout {
    /// Width and height, pixels.
    size_px: [usize; 2],
    is_progressive: bool,
    components: Vec<Component>,
    /// Coded units between two restart markers; 0 for none.
    restart_interval: usize,
    /// Restart markers that the current scan still needs.
    restarts_left: usize,
}

impl Layout {
    /// Takes a segment; what it cannot read is left to the decoder.
    fn read(&mut self, code: u8, segment: &[u8]) -> Result<(), &'static str> {
        match (code, segment) {
            (0xC0..=0xC2, &[_, h1, h0, w1, w0, _, ref components @ ..]) => {
                self.is_progressive = code == 0xC2;
                self.size_px = [[w1, w0], [h1, h0]].map(|bytes| usize::from(u16::from_be_bytes(bytes)));
                let component = |&[id, blocks, _]: &[u8; 3]| Component {
                    id,
                    blocks: [blocks >> 4, blocks & 15].map(|n| usize::from(n.max(1))),
                    coded: [false; 64],
                };
                self.components = components.as_chunks().0.iter().map(component).collect();
            }
            (0xDD, &[high, low]) => self.restart_interval = usize::from(u16::from_be_bytes([high, low])),
            (0xDA, &[count, ref rest @ ..]) => {
                if self.restarts_left > 0 {
                    return Err(NO_DATA);
                }
                let (of_scan, parameters) = rest.split_at_checked(2 * usize::from(count)).unwrap_or_default();
                let ids: Vec<u8> = of_scan.as_chunks().0.iter().map(|&[id, _]| id).collect();
                if let &[first, last, bits] = parameters {
                    self.scan(&ids, [first, last].map(usize::from), bits & 15);
                }
            }
            _ => {}
        }
        Ok(())
    }

    /// Takes a scan of some components: its coefficients, and the number of bits that it leaves to later scans.
    fn scan(&mut self, ids: &[u8], [first, last]: [usize; 2], bits_left: u8) {
        let coefficients = if self.is_progressive { first..=last.min(63) } else { 0..=63 };
        let most = [0, 1].map(|i| self.components.iter().map(|c| c.blocks[i]).max().unwrap_or(1));
        let mut units = [0, 1].map(|i| self.size_px[i].div_ceil(8 * most[i]));
        for component in self.components.iter_mut().filter(|c| ids.contains(&c.id)) {
            if ids.len() == 1 {
                units = [0, 1].map(|i| (self.size_px[i] * component.blocks[i]).div_ceil(8 * most[i]));
            }
            if bits_left == 0 || !self.is_progressive {
                component.coded.iter_mut().enumerate().for_each(|(i, c)| *c |= coefficients.contains(&i));
            }
        }
        let restarts = (units[0] * units[1]).div_ceil(self.restart_interval.max(1)).saturating_sub(1);
        self.restarts_left = if self.restart_interval == 0 { 0 } else { restarts };
    }

    /// Returns true if every component has all of its scans, and the last scan all of its restart markers.
    fn is_whole(&self) -> bool {
        self.restarts_left == 0 && self.components.iter().all(|component| component.coded.iter().all(|&coded| coded))
    }
}
