//! Tests of the library and the program from outside, in one binary (each links all of Burn).

mod ablations;
mod cli;
mod corrected_cli;
mod depth_cli;
mod devices;
mod drives;
mod eval_cli;
mod evidence;
mod exports;
mod files_as_people_have_them;
mod first_steps;
mod fuse_cli;
mod images_as_people_have_them;
mod kitti;
mod layouts;
mod layouts_in_trouble;
mod monodepth2;
mod nothing_silent;
mod oracles;
mod poses_as_people_have_them;
mod predict_cli;
mod report_page;
mod support;
mod synth_cli;
mod synthetic;
mod training;
