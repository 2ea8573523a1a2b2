//! `relcov doctor`: whether this program works on this machine, each line ok or with its remedy.

mod finding;
mod machine;
mod trial;

use clap::Args;

use super::terminal::print_result;
use super::version::{features, instructions};
use crate::COMMIT;
use crate::device::{DEVICE_NAMES, Presence, device_name, how_to_build, look_for_devices, open_device};
use crate::kernels::{Instructions, deviation_by, deviation_on};
use finding::{Finding, Say};

/// Convolutions deviate from their definition by less; GPUs that compute in 32-bit floats too.
const LARGEST_DEVIATION: f64 = 1e-5;

/// Arguments of `relcov doctor`.
#[derive(Args)]
#[command(after_help = "Examples:
  relcov doctor
  relcov doctor --device wgpu

Some ten seconds. Each line is ok, a note (-), or what is wrong (!!) with its remedy. The exit code is 0
where nothing is wrong. It looks at the current folder, in which runs are kept, and works in a
temporary one, which takes some 200 MB while it lasts.")]
pub struct DoctorArguments {
    #[arg(long, value_name = "DEVICE", default_value = "auto", help = format!("Where the tiny training runs: {DEVICE_NAMES}"))]
    device: String,
}

pub fn run(arguments: &DoctorArguments) -> anyhow::Result<()> {
    let mut wrong = 0;
    examine(arguments, &mut |topic, finding| {
        let (mark, text) = match finding {
            Finding::Ok(found) => ("ok", found),
            Finding::Note(found) => ("-", found),
            Finding::Wrong { found, remedy } => {
                wrong += 1;
                ("!!", format!("{found}\n{:<18}remedy: {remedy}", ""))
            }
        };
        print_result(&format!("{mark:<3}{topic:<15}{text}\n"))
    })?;
    match wrong {
        0 => print_result("nothing is wrong\n"),
        1 => anyhow::bail!("one thing is wrong: see its remedy above"),
        _ => anyhow::bail!("{wrong} things are wrong: see their remedies above"),
    }
}

/// From what there is to what it does; ends where nothing more can work.
fn examine(arguments: &DoctorArguments, say: Say) -> anyhow::Result<()> {
    let commit = COMMIT.map_or_else(String::new, |commit| format!(" ({commit})"));
    say("relcov", Finding::Ok(format!("{}{commit}, with {}", env!("CARGO_PKG_VERSION"), features())))?;
    say("threads", machine::threads())?;
    say("memory", machine::memory())?;
    say("disk", machine::disk())?;
    match instructions() {
        Ok(found) => say("instructions", Finding::Ok(found))?,
        Err(error) => return say("instructions", Finding::wrong(error.to_string(), "unset RELCOV_INSTRUCTIONS")),
    }
    say("kernels", kernels())?;
    for (name, presence) in look_for_devices() {
        say(name, computes(name, presence))?;
    }
    match open_device(&arguments.device) {
        Ok(device) => {
            say("device", Finding::Ok(format!("--device {} is {}", arguments.device, device_name(&device))))?;
            trial::run(&device, say)
        }
        Err(error) => say("device", Finding::wrong(error.to_string(), "name a --device that is ok above, or none")),
    }
}

/// Whether a device gives the right numbers, or how to have one.
fn computes(name: &str, presence: Presence) -> Finding {
    match presence {
        Presence::Found { part, device } => {
            let deviation = deviation_on(&device);
            let found = format!("{part}; a convolution and its gradients deviate by {deviation:.0e}");
            match deviation <= LARGEST_DEVIATION {
                true => Finding::Ok(found),
                false => Finding::wrong(found, format!("update its driver, and use another --device than {name}")),
            }
        }
        Presence::NotBuiltIn => Finding::Note(format!("not built in; {}", how_to_build(name))),
        Presence::NoGpu => Finding::Note("this machine shows no GPU".to_owned()),
        Presence::Unusable(error) => Finding::wrong(error.to_string(), "install its driver, or use another --device"),
    }
}

fn kernels() -> Finding {
    let deviations = Instructions::available().into_iter().map(|found| (found.name(), deviation_by(found)));
    let deviations: Vec<(&str, f64)> = deviations.collect();
    let texts: Vec<String> = deviations.iter().map(|(name, deviation)| format!("{name} {deviation:.0e}")).collect();
    let text = format!("deviations from the definition: {}", texts.join(", "));
    match deviations.iter().find(|(_, deviation)| *deviation > LARGEST_DEVIATION) {
        None => Finding::Ok(text),
        Some((name, _)) => Finding::wrong(
            text,
            format!("force others than {name} by RELCOV_INSTRUCTIONS, and report this processor as an issue"),
        ),
    }
}
