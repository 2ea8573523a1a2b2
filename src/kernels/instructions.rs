//! Which vector instructions the kernels use: the widest this processor has, or those a variable names.
//!
//! Every kernel is written once, generic over `pulp::Simd`, and compiled for each instruction set.

use std::sync::OnceLock;

use pulp::{NullaryFnOnce, Simd};

use crate::error::{Error, Result};

/// Environment variable that forces an instruction set, for tests and for hunting wrong results:
/// `avx512`, `avx2`, `neon` or `portable`; `burn` for Burn's own operations in place of the kernels.
/// Default: the widest this processor has.
const INSTRUCTIONS_VARIABLE: &str = "RELCOV_INSTRUCTIONS";

/// Vector instructions that were found on this processor.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Instructions {
    /// 16 lanes.
    #[cfg(target_arch = "x86_64")]
    Avx512(pulp::x86::V4),
    /// 8 lanes, with FMA.
    #[cfg(target_arch = "x86_64")]
    Avx2(pulp::x86::V3),
    /// 4 lanes.
    #[cfg(target_arch = "aarch64")]
    Neon(pulp::aarch64::Neon),
    /// Arrays of 4 values, left to the compiler: runs everywhere.
    Portable,
}

/// A kernel that is generic over the instruction set.
pub(crate) trait Kernel {
    /// What it returns.
    type Output;

    /// Runs with one instruction set. Must be `#[inline(always)]`, as all that it calls.
    fn run<S: Simd>(self, simd: S) -> Self::Output;
}

impl Instructions {
    /// All that this processor has, widest first.
    pub fn available() -> Vec<Self> {
        let mut available = Vec::new();
        #[cfg(target_arch = "x86_64")]
        {
            available.extend(pulp::x86::V4::try_new().map(Self::Avx512));
            available.extend(pulp::x86::V3::try_new().map(Self::Avx2));
        }
        #[cfg(target_arch = "aarch64")]
        available.extend(pulp::aarch64::Neon::try_new().map(Self::Neon));
        available.push(Self::Portable);
        available
    }

    /// Those in use: what [`INSTRUCTIONS_VARIABLE`] names, else the widest; `None` for Burn's operations.
    ///
    /// # Errors
    /// The variable names instructions that are unknown or that this processor lacks.
    pub fn chosen() -> Result<Option<Self>> {
        static CHOSEN: OnceLock<std::result::Result<Option<Instructions>, String>> = OnceLock::new();
        let chosen = CHOSEN.get_or_init(|| Self::named(std::env::var(INSTRUCTIONS_VARIABLE).ok().as_deref()));
        chosen.clone().map_err(|problem| Error::Device { name: "flex".to_owned(), problem })
    }

    /// As [`Instructions::chosen`] where kernels run at all: nothing reaches them otherwise.
    pub(crate) fn current() -> Self {
        Self::chosen().ok().flatten().unwrap_or_else(|| Self::available()[0])
    }

    fn named(name: Option<&str>) -> std::result::Result<Option<Self>, String> {
        let available = Self::available();
        match name {
            None | Some("") => Ok(Some(available[0])),
            Some("burn") => Ok(None),
            Some(name) => match available.iter().find(|instructions| instructions.name() == name) {
                Some(found) => Ok(Some(*found)),
                None => {
                    let names: Vec<&str> = available.iter().map(Self::name).collect();
                    let names = names.join(", ");
                    Err(format!("{INSTRUCTIONS_VARIABLE} is `{name}`; this processor has: {names}; or `burn`"))
                }
            },
        }
    }

    /// Name as in [`INSTRUCTIONS_VARIABLE`].
    pub fn name(&self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(_) => "avx2",
            #[cfg(target_arch = "aarch64")]
            Self::Neon(_) => "neon",
            Self::Portable => "portable",
        }
    }

    /// Runs a kernel compiled for these instructions.
    #[inline]
    pub(crate) fn run<K: Kernel>(self, kernel: K) -> K::Output {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512(simd) => simd.vectorize(Call { kernel, simd }),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2(simd) => simd.vectorize(Call { kernel, simd }),
            #[cfg(target_arch = "aarch64")]
            Self::Neon(simd) => simd.vectorize(Call { kernel, simd }),
            Self::Portable => pulp::Scalar128b.vectorize(Call { kernel, simd: pulp::Scalar128b }),
        }
    }
}

struct Call<K, S> {
    kernel: K,
    simd: S,
}

impl<K: Kernel, S: Simd> NullaryFnOnce for Call<K, S> {
    type Output = K::Output;

    #[inline(always)]
    fn call(self) -> K::Output {
        self.kernel.run(self.simd)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn portable_instructions_are_always_there_and_unknown_ones_are_named() {
        let name = |variable| Instructions::named(variable).unwrap().map(|found| found.name());
        assert_eq!(name(Some("portable")), Some("portable"));
        assert_eq!(name(Some("burn")), None);
        assert_eq!(name(None), Some(Instructions::available()[0].name()));
        let problem = Instructions::named(Some("mmx")).unwrap_err();
        assert!(problem.contains("`mmx`") && problem.contains("portable"), "{problem}");
    }
}
