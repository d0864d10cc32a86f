//! Devices of tensors: the processor or a CUDA device.

use crate::ModelError;
use tch::{Cuda, Device};

/// Parses `--device`: `auto` (the first CUDA device if libtorch finds one, else the processor), `cpu`, or `cuda:N`.
pub fn parse(name: &str) -> Result<Device, ModelError> {
    let devices = Cuda::device_count().max(0) as usize;
    let wrong = |allowed| Err(ModelError::Setting { key: "--device", value: name.to_owned(), allowed });
    match (name, name.strip_prefix("cuda:").map(str::parse::<usize>)) {
        ("auto", _) => Ok(Device::cuda_if_available()),
        ("cpu", _) => Ok(Device::Cpu),
        (_, Some(Ok(number))) if number < devices => Ok(Device::Cuda(number)),
        (_, Some(Ok(_))) if devices == 0 => wrong("this libtorch finds no CUDA device; use `cpu` or `auto`"),
        (_, Some(Ok(_))) => wrong("there is no CUDA device of this number"),
        _ => wrong("`auto`, `cpu`, or `cuda:0` and so on"),
    }
}

/// Sets the number of threads that libtorch uses in this process, at least 1.
pub fn set_threads(threads: usize) {
    tch::set_num_threads(i32::try_from(threads.max(1)).unwrap_or(i32::MAX));
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The processor is always available; a missing device, or an invalid name, is an error with the allowed values.
    #[test]
    fn devices_are_named() {
        assert_eq!(parse("cpu").unwrap(), Device::Cpu);
        assert_eq!(parse("auto").unwrap(), Device::cuda_if_available());
        assert!(parse("cuda:4096").unwrap_err().to_string().contains("CUDA device"));
        for name in ["gpu", "cuda", "cuda:", "cuda:-1", ""] {
            assert!(parse(name).unwrap_err().to_string().contains("`auto`, `cpu`"), "{name}");
        }
    }
}
