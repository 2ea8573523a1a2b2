//! The report in a real browser: it loads without errors, nothing overflows, tables and figures are there.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::support::{skip, write_pairs_csv};

/// What the page says of itself once it is laid out, as JSON in an element of its own.
const PROBE: &str = r#"<script>
addEventListener('error', event => errors.push(event.message), true);
var errors = [];
addEventListener('load', () => {
  const box = element => element.getBoundingClientRect();
  const figures = [...document.querySelectorAll('figure')].map(figure => {
    const svg = figure.querySelector('svg');
    return [figure.id, svg ? svg.querySelectorAll('path, polyline, rect, line').length : 0, svg ? Math.round(box(svg).width) : 0];
  });
  const tables = [...document.querySelectorAll('table')].map(table => [...table.rows].map(row => [...row.cells].map(cell => cell.firstChild ? cell.firstChild.textContent : '')));
  const loads = performance.getEntriesByType('resource').length;
  const probe = document.createElement('pre');
  probe.id = 'probe';
  probe.textContent = JSON.stringify({ errors, figures, tables, loads, width: document.documentElement.scrollWidth, view: innerWidth });
  document.body.append(probe);
});
</script></head>"#;

#[test]
fn the_page_loads_in_a_browser_with_its_tables_and_figures() {
    let Some(browser) = browser() else { return skip("no Chromium; set CHROMIUM or install it") };
    let folder = tempfile::tempdir().unwrap();
    let (pairs, result) = (folder.path().join("pairs.csv"), folder.path().join("mine.json"));
    write_pairs_csv(&pairs, 200, 1);
    let relcov = || assert_cmd::Command::cargo_bin("relcov").unwrap();
    relcov()
        .args(["eval", "--error-frame", "vehicle", "--pairs"])
        .arg(&pairs)
        .arg("--fit")
        .arg(&pairs)
        .arg("--save-results")
        .arg(&result)
        .assert()
        .success();
    let page = folder.path().join("report.html");
    relcov().arg("report").arg(&result).arg("--html").arg(&page).assert().success();
    let evaluation: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(&result).unwrap()).unwrap();

    let html = std::fs::read_to_string(&page).unwrap();
    assert!(
        !html.contains("http://")
            || html.matches("http://").count() == html.matches("http://www.w3.org/2000/svg").count()
    );
    assert!(!html.contains("<script"), "the page needs no script");
    std::fs::write(&page, html.replacen("</head>", PROBE, 1)).unwrap();
    for width in [1280, 500] {
        let probe = probe(&browser, folder.path(), &page, width);
        assert_eq!(probe["errors"].as_array().unwrap().len(), 0, "{}", probe["errors"]);
        assert_eq!(probe["loads"], 0, "one self-contained page");
        let (found, view) = (probe["width"].as_u64().unwrap(), probe["view"].as_u64().unwrap());
        assert!(found <= view, "at {width} px the page is {found} px wide");
        let figures: Vec<&str> =
            probe["figures"].as_array().unwrap().iter().map(|figure| figure[0].as_str().unwrap()).collect();
        let expected = [
            "sequence",
            "dispersion_vo",
            "reliability_vo",
            "conditional_vo",
            "coverage_vo",
            "sparsification_vo",
            "nees_vo",
            "speed_vo",
        ];
        assert_eq!(figures, expected);
        for figure in probe["figures"].as_array().unwrap() {
            assert!(figure[1].as_u64().unwrap() > 20 && figure[2].as_u64().unwrap() >= 700, "{figure}");
        }
        // The second table, after what is asked first: the MDE of x of the predictions, as evaluation.json has it.
        assert_eq!(probe["tables"][0][0][2], "NLL");
        let table = probe["tables"][1].as_array().unwrap();
        assert_eq!(table[0][2], "x [m]");
        let row = table.iter().find(|row| row[1] == "pairs").expect("the predictions");
        let shown: f64 = row[2].as_str().unwrap().parse().unwrap();
        let expected = evaluation["systems"]["vo"]["methods"]["pairs"]["mde"][0].as_f64().unwrap();
        assert!((shown / expected - 1.0).abs() < 5e-3, "{shown} against {expected}");
    }
}

fn browser() -> Option<PathBuf> {
    let named = std::env::var_os("CHROMIUM").map(PathBuf::from);
    let paths = std::env::var_os("PATH").unwrap_or_default();
    let names = ["chromium", "chromium-browser", "google-chrome", "chromium-headless-shell"];
    let found = std::env::split_paths(&paths).flat_map(|folder| names.map(|name| folder.join(name)));
    named.into_iter().chain(found).find(|path| path.is_file())
}

fn probe(browser: &Path, folder: &Path, page: &Path, width: u32) -> serde_json::Value {
    let output = Command::new(browser)
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--dump-dom"])
        .arg(format!("--user-data-dir={}", folder.join("profile").display()))
        .arg(format!("--window-size={width},900"))
        .arg(format!("file://{}", page.display()))
        .output()
        .unwrap();
    let dom = String::from_utf8_lossy(&output.stdout);
    let json = dom.split("<pre id=\"probe\">").nth(1).and_then(|rest| rest.split("</pre>").next());
    let json = json.unwrap_or_else(|| panic!("no answer: {}", String::from_utf8_lossy(&output.stderr)));
    serde_json::from_str(&json.replace("&gt;", ">").replace("&lt;", "<").replace("&amp;", "&")).unwrap()
}
