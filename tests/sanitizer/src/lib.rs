//! The files of `src/kernels` that know nothing of Burn, with their tests.
#![allow(dead_code, reason = "what calls them is left out")]

mod error {
    #[derive(Debug)]
    pub enum Error {
        Device { name: String, problem: String },
    }

    pub type Result<T> = std::result::Result<T, Error>;
}

#[path = "../../../src/kernels"]
mod kernels {
    mod activation;
    mod adam;
    mod border;
    mod buffer;
    mod convolution;
    mod dense;
    mod fused;
    mod instructions;
    mod layouts;
    mod pool;
    mod product;
    #[cfg(test)]
    mod reference;
    mod shape;
    mod tile;
    mod warp;
}
