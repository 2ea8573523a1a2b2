//! From one's own robot to factors for GTSAM, by the library alone: a pairs manifest (docs/own_data.md) is read, a model
//! trained on its first sequences, and the covariances of the last one printed.
//! `cargo run --release --example own_dataset -- PAIRS.csv FOLDER_OF_THE_RUN`

use std::path::Path;
use std::sync::Arc;

use relcov::config::Config;
use relcov::device::open_device;
use relcov::export::{ExportOptions, Format};
use relcov::pairs::{Dataset, PairScope, SplitName};
use relcov::recordings::Manifest;
use relcov::training::Learner;
use relcov::{Model, geometry::ErrorFrame};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [pairs, folder] = arguments.as_slice() else { anyhow::bail!("usage: own_dataset PAIRS.csv FOLDER") };

    // What the manifest holds decides the experiment; the last sequence is kept for the end.
    let manifest = Manifest::load(Path::new(pairs))?;
    let sequences: Vec<&str> = manifest.sequences().collect();
    let [train @ .., test] = sequences.as_slice() else { unreachable!("a manifest has a row") };
    anyhow::ensure!(!train.is_empty(), "{pairs} holds one sequence; training and testing need one each");
    let systems = manifest.systems();
    let list =
        |names: &[&str]| names.iter().map(|name| format!("{{ drive = {name:?} }}")).collect::<Vec<_>>().join(", ");
    let system = |name: &&str| {
        format!("[[systems]]\nname = {name:?}\nshare = {}\nsource = \"manifest\"\n", 1.0 / systems.len() as f64)
    };
    let depth = if manifest.has_depth() { "manifest" } else { "ground_plane" };
    let text = format!(
        "name = \"own\"\ncheckpoints = {folder:?}\n[data]\nmanifest = {:?}\ntrain = [{}]\ntest = [{}]\n[truth]\nsource = \"manifest\"\n{}\
         [depth]\nsource = {depth:?}\n[model]\nwidth = 192\nheight = 64\n[training]\nbatch = {batch}\nmicro_batch = {batch}\nepochs = 4\n",
        Path::new(pairs).canonicalize()?.display().to_string(),
        list(train),
        list(&[test]),
        systems.iter().map(system).collect::<String>(),
        batch = 4 * systems.len(),
    );
    let path = Path::new(folder).join("own.toml");
    std::fs::create_dir_all(folder)?;
    std::fs::write(&path, text)?;

    let config = Config::load(&path, &[])?;
    let device = open_device(&config.device)?;
    let dataset = Arc::new(Dataset::load(&config.pairs(), PairScope::Images)?);
    let mut learner = Learner::start(config.clone(), dataset.clone(), &device, true)?;
    learner.train(&mut |_| {})?;

    let model = Model::load(config.run_folder(), &device)?;
    let pairs = dataset.require(SplitName::Test)?;
    let predicted = model.predict_measurements(&config, &dataset, pairs, ErrorFrame::Vehicle, &mut |_| Ok(()))?;
    for measured in &predicted {
        println!("# {} on {}, {} axes", measured.system, measured.drive, measured.frame.name());
        print!("{}", Format::Gtsam.render(measured, &ExportOptions::default())?);
    }
    Ok(())
}
