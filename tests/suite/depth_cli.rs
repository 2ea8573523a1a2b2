//! Depth from the command line: a network's maps in their cache, depth trained here, and what can go wrong.

use std::path::{Path, PathBuf};
use std::time::Duration;

use assert_cmd::Command;
use relcov::synthetic::{Replace, SyntheticSettings, record};

const DRIVE: &str = "2026_01_01_drive_0001_sync";

fn relcov() -> Command {
    let mut command = Command::cargo_bin("relcov").unwrap();
    command.env_remove("RELCOV_DATA_ROOT").env_remove("RUST_LOG").timeout(Duration::from_secs(1800));
    command
}

/// A rendered drive with scans and true depth, and a configuration that wants the depth of a network.
struct Street {
    folder: tempfile::TempDir,
}

impl Street {
    const FRAMES: usize = 12;

    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let settings = SyntheticSettings {
            drives: 1,
            frames: Self::FRAMES,
            size: [192, 64],
            lidar_steps: 360,
            ..SyntheticSettings::default()
        };
        assert!(record(&folder.path().join("data"), &settings, Replace::Never, &mut |_| Ok(())).unwrap());
        let street = Self { folder };
        let weights = street.path("weights");
        std::fs::create_dir(&weights).unwrap();
        for file in ["encoder.pth", "depth.pth"] {
            std::fs::copy(fixture().join(file), weights.join(file)).unwrap();
        }
        std::fs::write(
            street.config(),
            format!(
                r#"name = "street"
checkpoints = "runs"
device = "flex"
[data]
root = "data"
train = [{{ drive = "{DRIVE}", frames = [0, 6] }}]
validation = [{{ drive = "{DRIVE}", frames = [6, 9] }}]
test = [{{ drive = "{DRIVE}", frames = [9, 12] }}]
[[systems]]
name = "vo"
share = 0.75
source = "relative"
path = "measurements/vo/{{drive}}.csv"
frame = "camera2"
[[systems]]
name = "gnss"
share = 0.25
source = "truth"
[depth]
source = "monodepth2"
weights = "weights"
[model]
width = 96
height = 32
[training]
batch = 4
micro_batch = 4
epochs = 1
batches_per_epoch = 1
[depth_training]
width = 192
height = 64
batch = 2
epochs = 2
batches_per_epoch = 2
"#
            ),
        )
        .unwrap();
        street
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.folder.path().join(relative)
    }

    fn config(&self) -> PathBuf {
        self.path("config.toml")
    }

    fn map(&self, frame: usize) -> PathBuf {
        self.path(&format!("runs/depth/weights/2026_01_01/{DRIVE}/{frame:010}.png"))
    }

    fn run(&self, command: &str, arguments: &[&str]) -> Command {
        let mut run = relcov();
        run.arg(command).arg("--config").arg(self.config()).args(arguments);
        run
    }

    /// What a failing command says; it must not panic.
    fn refused(&self, command: &str, arguments: &[&str]) -> String {
        let output = self.run(command, arguments).assert().code(1).get_output().clone();
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(!message.contains("panicked"), "{message}");
        message
    }
}

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/monodepth2")
}

fn stdout(command: &mut Command) -> String {
    String::from_utf8(command.assert().success().get_output().stdout.clone()).unwrap()
}

#[test]
fn maps_are_made_once_and_used_by_train_and_eval() {
    let street = Street::new();
    let message = street.refused("train", &[]);
    assert!(message.contains("relcov depth --config"), "{message}");

    let report = stdout(&mut street.run("depth", &[]));
    assert!(report.contains("11 maps made, 0 kept"), "{report}");
    assert!(report.contains("own scan: 11; by the sequence's factor: 0"), "{report}");
    let first = std::fs::read(street.map(4)).unwrap();

    // One is lost: the others are kept, and it comes back as it was.
    std::fs::remove_file(street.map(4)).unwrap();
    let message = street.refused("train", &[]);
    assert!(message.contains("lacks the maps of 1 of 11 image pairs"), "{message}");
    let report = stdout(&mut street.run("depth", &[]));
    assert!(report.contains("1 maps made, 10 kept"), "{report}");
    assert_eq!(first, std::fs::read(street.map(4)).unwrap());

    street.run("train", &[]).assert().success();
    relcov().arg("eval").arg("--run").arg(street.path("runs/street")).assert().success();

    // A map that a power cut left empty is made again.
    std::fs::write(street.map(4), []).unwrap();
    let report = stdout(&mut street.run("depth", &[]));
    assert!(report.contains("1 maps made, 10 kept"), "{report}");
    assert_eq!(first, std::fs::read(street.map(4)).unwrap());

    // Without drives to watch, the end of the training drive is held out; the maps still suffice.
    let held_out = ["--set", "data.validation=[]", "--set", "data.validation_fraction=0.4", "--set", "name=held_out"];
    street.run("train", &held_out).assert().success();

    // Another drive of the same name has other depth.
    let image = street.path(&format!("data/2026_01_01/{DRIVE}/image_02/data/0000000000.png"));
    let kept = std::fs::read(&image).unwrap();
    image::RgbImage::new(192, 64).save(&image).unwrap();
    let message = street.refused("train", &["--set", "name=other"]);
    assert!(message.contains("another drive of that name"), "{message}");
    std::fs::write(&image, kept).unwrap();

    // The maps do not fit other settings or other weights, and --force renews them.
    let message = street.refused("train", &["--set", "name=other", "--set", "depth.scale=median"]);
    assert!(message.contains("scale: Mean there, Median wanted") && message.contains("--force"), "{message}");
    let message = street.refused("depth", &["--set", "depth.scale.fixed=2.0"]);
    assert!(message.contains("Fixed(2.0) wanted") && message.contains("--force"), "{message}");
    let report = stdout(&mut street.run("depth", &["--set", "depth.scale.fixed=2.0", "--force"]));
    assert!(report.contains("11 maps made"), "{report}");
    assert_ne!(first, std::fs::read(street.map(4)).unwrap());
}

#[test]
fn a_frame_without_a_usable_scan_takes_the_factor_of_its_sequence() {
    let street = Street::new();
    let scan = |frame: usize| street.path(&format!("data/2026_01_01/{DRIVE}/velodyne_points/data/{frame:010}.bin"));
    std::fs::write(scan(2), []).unwrap();
    // One return behind the car.
    let behind: Vec<u8> = [-5.0_f32, 0.0, 0.0, 0.1].iter().flat_map(|value| value.to_le_bytes()).collect();
    std::fs::write(scan(5), behind).unwrap();
    std::fs::remove_file(scan(7)).unwrap();
    let output = street.run("depth", &[]).assert().success().get_output().clone();
    let (report, warnings) = (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert!(report.contains("own scan: 8; by the sequence's factor: 3"), "{report}");
    assert!(warnings.contains("0000000002.bin") && warnings.contains("multiple of 16"), "{warnings}");
    assert!(warnings.contains("frame 5: no LiDAR return falls on the image"), "{warnings}");

    for frame in 0..Street::FRAMES {
        let _ = std::fs::remove_file(scan(frame));
    }
    // Nothing is lost where nothing can be made.
    let message = street.refused("depth", &["--force"]);
    assert!(message.contains("depth.scale = { fixed"), "{message}");
    assert!(street.map(1).exists());
}

#[test]
fn depth_is_judged_and_compared() {
    let street = Street::new();
    let truth = "{date}/{drive}/depth_02/data/{frame}.png";
    let files = format!("files={truth}");
    let source = ["--set", "depth.source=files", "--set", "depth.path={date}/{drive}/depth_02/data/{frame}.png"];
    let perfect = stdout(street.run("depth", &source).args(["--evaluate", "--truth", truth]));
    assert!(perfect.contains("| as it is      |   0.000 |"), "{perfect}");
    let by_scans = stdout(street.run("depth", &source).arg("--evaluate"));
    assert!(by_scans.contains("LiDAR returns"), "{by_scans}");

    let sheet = street.path("sheet.png");
    let arguments = ["--compare", "lidar", "--compare", &files, "--compare", "ground_plane", "--contact-sheet"];
    let table = stdout(street.run("depth", &arguments).arg(&sheet));
    // True depth explains the images best.
    let differences: Vec<f64> = table
        .lines()
        .filter_map(|line| line.trim_end_matches([' ', '|']).rsplit('|').next()?.trim().parse().ok())
        .collect();
    let [lidar, files, plane, unwarped] = differences[..] else { panic!("{table}") };
    assert!(files < plane && files < unwarped && lidar < unwarped, "{table}");
    assert_eq!(image::open(&sheet).unwrap().height() as usize % 3, 1, "three rows and the gaps around them");

    let message = street.refused("depth", &["--compare", "sonar"]);
    assert!(message.contains("sonar") && message.contains("ground_plane, lidar"), "{message}");
}

#[test]
fn unusable_weights_and_images_are_named_and_leave_no_map() {
    let street = Street::new();
    let weights = street.path("weights");
    let cases: [(&str, &str, Vec<u8>, &[&str]); 5] = [
        // A pickle that would make a folder if anything in it were run.
        (
            "a program",
            "encoder.pth",
            format!("cos\nmkdir\n(S'{}'\ntR.", street.path("executed").display()).into_bytes(),
            &["encoder.pth", "state dict"],
        ),
        ("text", "depth.pth", b"these are no weights".to_vec(), &["depth.pth", "state dict"]),
        ("nothing", "encoder.pth", Vec::new(), &["encoder.pth", "state dict"]),
        ("half a file", "encoder.pth", half(&fixture().join("encoder.pth")), &["encoder.pth"]),
        (
            "the decoder for the encoder",
            "encoder.pth",
            std::fs::read(fixture().join("depth.pth")).unwrap(),
            &["encoder.conv1.weight", "no such key", "ResNet-18"],
        ),
    ];
    for (name, file, bytes, expected) in cases {
        let kept = std::fs::read(weights.join(file)).unwrap();
        std::fs::write(weights.join(file), bytes).unwrap();
        let message = street.refused("depth", &[]);
        assert!(expected.iter().all(|part| message.contains(part)), "{name}: {message}");
        std::fs::write(weights.join(file), kept).unwrap();
    }
    assert!(!street.path("executed").exists(), "something in a .pth file was run");
    let message = street.refused("depth", &["--set", "depth.weights=nowhere"]);
    assert!(message.contains("nowhere") && message.contains("encoder.pth"), "{message}");
    assert!(!street.path("runs/depth").exists());

    // A square image would be squeezed beyond recognition.
    let image = street.path(&format!("data/2026_01_01/{DRIVE}/image_02/data/0000000003.png"));
    image::RgbImage::new(64, 64).save(&image).unwrap();
    let message = street.refused("depth", &[]);
    assert!(message.contains("data.max_bad_fraction"), "{message}");
    let tolerant = ["--set", "data.max_bad_fraction=0.2"];
    let output = street.run("depth", &tolerant).assert().success().get_output().clone();
    let warnings = String::from_utf8(output.stderr).unwrap();
    assert!(warnings.contains("0000000003.png") && warnings.contains("64x64"), "{warnings}");
    assert!(warnings.contains("1 frames could not be read"), "{warnings}");
    assert!(!street.map(3).exists() && street.map(4).exists());
    let leftovers = std::fs::read_dir(street.map(4).parent().unwrap()).unwrap();
    assert!(leftovers.filter_map(Result::ok).all(|entry| entry.path().extension().is_some_and(|e| e == "png")));
}

#[test]
fn a_depth_map_that_knows_no_pixel_is_refused() {
    let street = Street::new();
    for frame in 0..Street::FRAMES {
        let path = street.path(&format!("data/2026_01_01/{DRIVE}/depth_02/data/{frame:010}.png"));
        image::ImageBuffer::<image::Luma<u16>, Vec<u16>>::new(192, 64).save(path).unwrap();
    }
    let source = ["--set", "depth.source=files", "--set", "depth.path={date}/{drive}/depth_02/data/{frame}.png"];
    let message = street.refused("train", &source);
    assert!(message.contains("the depth of not one pixel is known"), "{message}");
}

#[test]
fn a_depth_network_is_trained_interrupted_resumed_and_used() {
    let street = Street::new();
    let whole = street.path("whole");
    street.run("train-depth", &["--out"]).arg(&whole).assert().success();

    // One epoch, then the other: the same numbers as at once.
    let halves = street.path("halves");
    let one = ["--set", "depth_training.epochs=1", "--set", "depth_training.schedule=constant", "--out"];
    street.run("train-depth", &one).arg(&halves).assert().success();
    let once = street.path("once");
    let both = ["--set", "depth_training.schedule=constant", "--out"];
    street.run("train-depth", &both).arg(&once).assert().success();
    relcov()
        .arg("train-depth")
        .arg("--resume")
        .arg(&halves)
        .args(["--set", "depth_training.epochs=2"])
        .assert()
        .success();
    let metrics = |folder: &Path| std::fs::read_to_string(folder.join("metrics.csv")).unwrap();
    assert_eq!(metrics(&halves), metrics(&once));
    assert_eq!(metrics(&halves).lines().count(), 3);

    let message = street.refused("train-depth", &["--out", whole.to_str().unwrap()]);
    assert!(message.contains("--force"), "{message}");
    let output = relcov()
        .arg("train-depth")
        .arg("--resume")
        .arg(&whole)
        .args(["--set", "depth_training.batch=3"])
        .assert()
        .code(1)
        .get_output()
        .clone();
    assert!(String::from_utf8(output.stderr).unwrap().contains("other settings"));

    // Of another aspect than the images: said before hours of training, and before maps are made.
    let message = street.refused("train-depth", &["--set", "depth_training.width=96", "--out", "narrow"]);
    assert!(message.contains("squeezed 2.00 times"), "{message}");
    // Published weights are never mixed with one's own.
    let message = street.refused("train-depth", &["--force"]);
    assert!(message.contains("holds published weights"), "{message}");

    // Its depth needs no LiDAR and is used like any other.
    let own = format!("depth.weights={}", whole.display());
    let report = stdout(&mut street.run("depth", &["--set", &own]));
    assert!(report.contains("11 maps made") && !report.contains("scan"), "{report}");
    street.run("train", &["--set", &own]).assert().success();
}

fn half(path: &Path) -> Vec<u8> {
    let bytes = std::fs::read(path).unwrap();
    bytes[..bytes.len() / 2].to_vec()
}
