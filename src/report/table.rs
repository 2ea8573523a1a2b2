//! A table and its forms: text, Markdown, CSV, LaTeX.

use clap::ValueEnum;
use comfy_table::{CellAlignment, presets};

/// Form of a table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum TableFormat {
    /// For terminals; the best values bear a star.
    #[default]
    Text,
    /// For pages; the best values are bold.
    Markdown,
    /// For programs; numbers in full.
    Csv,
    /// For papers (booktabs), methods side by side as in the paper's Table II; the best values are bold.
    Latex,
}

impl TableFormat {
    /// The form that a file name asks for by its extension.
    pub fn of_extension(extension: &str) -> Option<Self> {
        match extension {
            "txt" => Some(Self::Text),
            "md" => Some(Self::Markdown),
            "csv" => Some(Self::Csv),
            "tex" => Some(Self::Latex),
            _ => None,
        }
    }
}

/// Rows of names, then values.
#[derive(Clone, Debug, PartialEq)]
pub struct Table {
    /// What it shows.
    pub title: String,
    /// Column names with units.
    pub header: Vec<String>,
    /// How many of the columns hold names.
    pub names: usize,
    /// Cells.
    pub rows: Vec<Vec<Cell>>,
}

/// A cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cell {
    /// As shown to people; empty where there is nothing.
    pub text: String,
    /// The number behind it, for programs.
    pub value: Option<f64>,
    /// Whether it is the best of those it is compared with.
    pub best: bool,
}

impl Cell {
    /// A name.
    pub fn name(text: impl Into<String>) -> Self {
        Self { text: text.into(), ..Self::default() }
    }
}

impl Table {
    /// The table in a form, ending with a line break.
    pub fn render(&self, format: TableFormat) -> String {
        match format {
            TableFormat::Text => {
                self.grid(&|cell| if cell.best { format!("{}*", cell.text) } else { cell.text.clone() })
            }
            TableFormat::Markdown => format!(
                "{}\n\n{}",
                self.title,
                self.grid(&|cell| if cell.best { format!("**{}**", cell.text) } else { cell.text.replace('|', "\\|") })
            ),
            TableFormat::Csv => self.csv(),
            TableFormat::Latex => self.latex(),
        }
    }

    fn grid(&self, show: &dyn Fn(&Cell) -> String) -> String {
        let mut table = comfy_table::Table::new();
        table.load_style(presets::ASCII_MARKDOWN);
        table.set_header(&self.header);
        for row in &self.rows {
            let cells = row.iter().map(|cell| if cell.text.is_empty() { "-".to_owned() } else { show(cell) });
            table.add_row(cells);
        }
        for column in table.column_iter_mut().skip(self.names) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        format!("{table}\n")
    }

    fn csv(&self) -> String {
        let mut writer = csv::Writer::from_writer(Vec::new());
        let number = |cell: &Cell| cell.value.map_or(cell.text.clone(), |value| value.to_string());
        let rows = self.rows.iter().map(|row| row.iter().map(number).collect());
        for row in std::iter::once(self.header.clone()).chain(rows) {
            writer.write_record(&row).expect("rows of one length in memory");
        }
        String::from_utf8(writer.into_inner().expect("in memory")).expect("text")
    }

    fn latex(&self) -> String {
        let columns = "l".repeat(self.names) + &"r".repeat(self.header.len() - self.names);
        let line = |cells: Vec<String>| format!("{} \\\\\n", cells.join(" & "));
        let show = |cell: &Cell| match (cell.text.as_str(), cell.best) {
            ("", _) => "--".to_owned(),
            (text, true) => format!("\\textbf{{{}}}", escape_latex(text)),
            (text, false) => escape_latex(text),
        };
        let mut text = format!("% {}\n\\begin{{tabular}}{{{columns}}}\n\\toprule\n", self.title.replace('\n', "\n% "));
        text += &line(self.header.iter().map(|name| escape_latex(name)).collect());
        for (index, row) in self.rows.iter().enumerate() {
            // A rule wherever the first name changes.
            if index == 0 || self.rows[index - 1][0] != row[0] {
                text += "\\midrule\n";
            }
            text += &line(row.iter().map(show).collect());
        }
        text + "\\bottomrule\n\\end{tabular}\n"
    }

    /// Marks the best value of each column among the rows of each group (equal first name) that compete.
    pub fn mark_best(&mut self, competes: impl Fn(&[Cell]) -> bool, better: &[Better]) {
        for (offset, better) in better.iter().enumerate() {
            let column = self.names + offset;
            let mut first = 0;
            while first < self.rows.len() {
                let same = |row: &&Vec<Cell>| row[0] == self.rows[first][0];
                let end = first + self.rows[first..].iter().take_while(same).count();
                let rank =
                    |row: &Vec<Cell>| row[column].value.filter(|_| competes(row)).and_then(|value| better.rank(value));
                let ranks: Vec<Option<f64>> = self.rows[first..end].iter().map(rank).collect();
                mark(self.rows[first..end].iter_mut().map(|row| &mut row[column]), &ranks);
                first = end;
            }
        }
    }
}

/// Marks the cell of the lowest rank, and those that read the same; a single one is not the best of any.
pub(super) fn mark<'a>(cells: impl Iterator<Item = &'a mut Cell>, ranks: &[Option<f64>]) {
    if ranks.iter().flatten().count() < 2 {
        return;
    }
    let best = ranks.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let mut ranked: Vec<(&mut Cell, Option<f64>)> = cells.zip(ranks.iter().copied()).collect();
    let text = ranked.iter().find(|(_, rank)| *rank == Some(best)).map(|(cell, _)| cell.text.clone());
    for (cell, rank) in &mut ranked {
        cell.best = rank.is_some() && text.as_ref() == Some(&cell.text);
    }
}

/// Which values are good.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Better {
    /// Small ones.
    Lower,
    /// Those near a target.
    Near(f64),
    /// Neither.
    Neutral,
}

impl Better {
    /// Smaller is better.
    pub(super) fn rank(self, value: f64) -> Option<f64> {
        match self {
            Self::Lower => Some(value),
            Self::Near(target) => Some((value - target).abs()),
            Self::Neutral => None,
        }
    }
}

fn escape_latex(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '_' | '%' | '&' | '#' | '$' | '{' | '}' => escaped.extend(['\\', character]),
            '\\' => escaped += "\\textbackslash{}",
            '~' => escaped += "\\textasciitilde{}",
            '^' => escaped += "\\textasciicircum{}",
            '<' => escaped += "\\textless{}",
            'σ' => escaped += "$\\sigma$",
            '√' => escaped += "$\\surd$",
            character => escaped.push(character),
        }
    }
    escaped
}

/// Three significant digits, in powers of ten where decimals would run long.
pub fn three_digits(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    // Of the rounded value: 0.009996 is 0.0100.
    let scientific = format!("{value:.2e}");
    let exponent: i32 = scientific.rsplit('e').next().and_then(|exponent| exponent.parse().ok()).unwrap_or(0);
    if (-3..3).contains(&exponent) { format!("{value:.*}", (2 - exponent).max(0) as usize) } else { scientific }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        let row = |method: &str, value: f64| {
            vec![
                Cell::name("vo"),
                Cell::name(method),
                Cell { text: three_digits(value), value: Some(value), best: false },
            ]
        };
        let rows = vec![
            row("a_b", 0.25),
            row("constant", 0.5),
            row("zero", 0.0),
            vec![Cell::name("gnss"), Cell::name("a_b"), Cell::default()],
        ];
        let header = ["system", "method", "x [m]"].map(str::to_owned).into();
        let mut table = Table { title: "MDE".to_owned(), header, names: 2, rows };
        table.mark_best(|row| row[1].text != "zero", &[Better::Lower]);
        table
    }

    #[test]
    fn one_table_has_four_forms() {
        for format in [TableFormat::Text, TableFormat::Markdown, TableFormat::Csv, TableFormat::Latex] {
            insta::assert_snapshot!(format!("{format:?}"), table().render(format));
        }
    }

    #[test]
    fn numbers_have_three_significant_digits() {
        for (value, text) in [
            (0.0, "0"),
            (0.04937, "0.0494"),
            (0.00123, "0.00123"),
            (2.76e-6, "2.76e-6"),
            (12.34, "12.3"),
            (0.009996, "0.0100"),
            (4e-4, "4.00e-4"),
        ] {
            assert_eq!(three_digits(value), text);
        }
    }
}
