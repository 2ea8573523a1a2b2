//! Covariance of one measurement by a trained model:
//! `cargo run --release --example predict_pair -- RUN FRAME0.png FRAME1.png FORWARD_M`

use relcov::depth::ground_plane_depth;
use relcov::geometry::{Pinhole, Pose, Tangent};
use relcov::recordings::read_image;
use relcov::{Measurement, Model, device::open_device};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [run, source, target, forward_m] = arguments.as_slice() else {
        anyhow::bail!("usage: predict_pair RUN FRAME0 FRAME1 FORWARD_M");
    };
    // Intrinsics of KITTI's 2011_09_30 colour camera, at the size of its images.
    let camera = Pinhole { fx: 707.0912, fy: 707.0912, cx: 601.8873, cy: 183.1104, width: 1226, height: 370 };
    let model = Model::load(run, &open_device("auto")?)?;
    let covariance = model.predict(&Measurement {
        source_image: read_image(source.as_ref())?,
        target_image: read_image(target.as_ref())?,
        target_depth: ground_plane_depth(&camera, 1.65, None, 80.0),
        camera,
        // The camera moved forward, along its z axis.
        source_from_target: Pose::exp(&Tangent::new(0.0, 0.0, forward_m.parse()?, 0.0, 0.0, 0.0)),
        right: None,
        camera_from_vehicle: None,
    })?;
    let [x, y, z, roll, pitch, yaw]: [f64; 6] = covariance.std_devs().into();
    println!("one sigma, {} axes:", model.error_frame().name());
    println!("x {x:.4} m, y {y:.4} m, z {z:.4} m, roll {roll:.2e} rad, pitch {pitch:.2e} rad, yaw {yaw:.2e} rad");
    Ok(())
}
