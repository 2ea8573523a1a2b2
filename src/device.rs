//! From `--device` to a Burn device: backends are swapped here and nowhere else.

use burn::tensor::Device;

use crate::error::{Error, Result};

/// Names that `--device` accepts, for help texts.
pub const DEVICE_NAMES: &str = "auto | flex | ndarray | wgpu | vulkan | cuda[:i]";

/// Backends by their names for `--device`, which are also those of their cargo features, and whether this program was
/// built with them.
pub const BACKENDS: [(&str, bool); 5] = [
    ("flex", cfg!(feature = "flex")),
    ("ndarray", cfg!(feature = "ndarray")),
    ("wgpu", cfg!(feature = "wgpu")),
    ("vulkan", cfg!(feature = "vulkan")),
    ("cuda", cfg!(feature = "cuda")),
];

/// What there is of a backend.
pub enum Presence {
    /// A device that [`open_device`] opens.
    Found {
        /// The part's own name; `CPU` where it has none.
        part: String,
        /// The device itself.
        device: Device,
    },
    /// This program was built without it.
    NotBuiltIn,
    /// The system shows no GPU.
    NoGpu,
    /// It is built in and cannot be used.
    Unusable(Error),
}

/// Looks for a device of each of [`BACKENDS`]; for GPUs where the system shows one.
pub fn look_for_devices() -> Vec<(&'static str, Presence)> {
    let presence = |name: &str, built_in: bool| {
        if !built_in {
            return Presence::NotBuiltIn;
        }
        if !matches!(name, "flex" | "ndarray") && !may_have_gpu() {
            return Presence::NoGpu;
        }
        match open_device(name) {
            Ok(device) => Presence::Found { part: part(&device), device },
            Err(error) => Presence::Unusable(error),
        }
    };
    BACKENDS.into_iter().map(|(name, built_in)| (name, presence(name, built_in))).collect()
}

/// Opens a device by name.
///
/// `auto` is a real GPU when one is there (never a software rasteriser), else flex.
///
/// # Errors
/// The name is unknown, its backend is not compiled in, or the machine has no such device.
pub fn open_device(name: &str) -> Result<Device> {
    let (backend, index) = name.split_once(':').map_or((name, None), |(backend, index)| (backend, Some(index)));
    match (backend, index) {
        ("auto", None) => auto(),
        ("flex", None) => flex(name),
        ("ndarray", None) => ndarray(name),
        ("wgpu", None) => wgpu(name),
        ("vulkan", None) => vulkan(name),
        ("cuda", index) => cuda(name, index),
        _ => Err(Error::Device { name: name.to_owned(), problem: format!("unknown; expected {DEVICE_NAMES}") }),
    }
}

/// Short name of an opened device's backend, as stored with results.
pub fn device_name(device: &Device) -> String {
    let debug = format!("{device:?}").to_lowercase();
    ["flex", "ndarray", "cuda", "vulkan", "wgpu"]
        .into_iter()
        .find(|name| debug.contains(name))
        .map_or(debug.clone(), str::to_owned)
}

/// Whether training on this device is so slow that the user should know.
pub fn is_slow_to_train(device: &Device) -> bool {
    device_name(device) == "ndarray"
}

fn not_compiled(name: &str, feature: &str) -> Error {
    Error::Device {
        name: name.to_owned(),
        problem: format!("this program was built without it; {}", how_to_build(feature)),
    }
}

/// How to come by a program with this backend.
pub(crate) fn how_to_build(feature: &str) -> String {
    format!("build it in: cargo build --release --features {feature} (or cargo install --path . --features {feature})")
}

#[cfg(any(feature = "wgpu", feature = "cuda"))]
fn part(device: &Device) -> String {
    device.identity().map_or("CPU".to_owned(), |identity| identity.name)
}

#[cfg(not(any(feature = "wgpu", feature = "cuda")))]
fn part(_: &Device) -> String {
    "CPU".to_owned()
}

#[cfg(feature = "flex")]
fn flex(_: &str) -> Result<Device> {
    crate::kernels::Instructions::chosen()?;
    Ok(Device::flex())
}

#[cfg(not(feature = "flex"))]
fn flex(name: &str) -> Result<Device> {
    Err(not_compiled(name, "flex"))
}

#[cfg(feature = "ndarray")]
#[allow(deprecated, reason = "users ask for ndarray by name; flex is the CPU default")]
fn ndarray(_: &str) -> Result<Device> {
    Ok(Device::ndarray())
}

#[cfg(not(feature = "ndarray"))]
fn ndarray(name: &str) -> Result<Device> {
    Err(not_compiled(name, "ndarray"))
}

#[cfg(feature = "wgpu")]
fn wgpu(name: &str) -> Result<Device> {
    adapter(name, burn::tensor::DeviceType::Wgpu)
}

#[cfg(not(feature = "wgpu"))]
fn wgpu(name: &str) -> Result<Device> {
    Err(not_compiled(name, "wgpu"))
}

#[cfg(feature = "vulkan")]
fn vulkan(name: &str) -> Result<Device> {
    adapter(name, burn::tensor::DeviceType::Vulkan)
}

#[cfg(not(feature = "vulkan"))]
fn vulkan(name: &str) -> Result<Device> {
    Err(not_compiled(name, "vulkan"))
}

#[cfg(feature = "cuda")]
fn cuda(name: &str, index: Option<&str>) -> Result<Device> {
    let problem = |problem: String| Error::Device { name: name.to_owned(), problem };
    let index: usize = match index {
        None => 0,
        Some(index) => index
            .parse()
            .map_err(|_| problem(format!("`{index}` is not a number; expected cuda or cuda:0, cuda:1, …")))?,
    };
    let devices: Vec<Device> = Device::enumerate(burn::tensor::DeviceType::Cuda).into_iter().collect();
    let count = devices.len();
    devices
        .into_iter()
        .nth(index)
        .ok_or_else(|| problem(format!("there are {count} CUDA devices here; use another --device, such as flex")))
}

#[cfg(not(feature = "cuda"))]
fn cuda(name: &str, _: Option<&str>) -> Result<Device> {
    Err(not_compiled(name, "cuda"))
}

/// A graphics adapter, a real GPU before a software rasteriser.
#[cfg(feature = "wgpu")]
fn adapter(name: &str, kind: burn::tensor::DeviceType) -> Result<Device> {
    let mut devices: Vec<Device> = Device::enumerate(kind).into_iter().collect();
    devices.sort_by_key(|device| !is_real_gpu(device));
    let device = devices.into_iter().next().ok_or_else(|| Error::Device {
        name: name.to_owned(),
        problem: "no graphics adapter was found; install a GPU driver (or mesa-vulkan-drivers for a software one), or use --device flex".to_owned(),
    })?;
    if !is_real_gpu(&device) {
        tracing::warn!("device `{name}` is a software rasteriser: far slower than --device flex");
    }
    Ok(device)
}

/// A software rasteriser is no physical device.
#[cfg(feature = "wgpu")]
fn is_real_gpu(device: &Device) -> bool {
    device.identity().is_some_and(|identity| identity.physical.is_some())
}

fn auto() -> Result<Device> {
    #[cfg(feature = "cuda")]
    if let Ok(device) = cuda("auto", None) {
        return Ok(device);
    }
    #[cfg(feature = "wgpu")]
    if may_have_gpu()
        && let Some(device) = Device::enumerate(burn::tensor::DeviceType::Wgpu).into_iter().find(is_real_gpu)
    {
        return Ok(device);
    }
    if cfg!(feature = "flex") {
        flex("auto")
    } else if cfg!(feature = "ndarray") {
        ndarray("auto")
    } else {
        Err(Error::Device {
            name: "auto".to_owned(),
            problem: format!("no GPU was found; for the CPU, {}", how_to_build("flex")),
        })
    }
}

/// Linux shows a GPU as a device file. Without one nothing is probed: drivers that are installed on a
/// machine without a GPU write alarming lines to stderr.
fn may_have_gpu() -> bool {
    let files = ["/dev/dri", "/dev/nvidiactl", "/dev/dxg", "/dev/mali0"];
    !cfg!(target_os = "linux") || files.iter().any(|file| std::path::Path::new(file).exists())
}
