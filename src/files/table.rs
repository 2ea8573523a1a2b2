//! CSV files, read by the names of their columns.

use std::path::Path;

use csv::StringRecord;

use super::text::{frame_index, is_passed_over, remarks, without_mark};
use crate::error::{Error, Place, Result, excerpt};

/// What a CSV file may hold.
pub(crate) struct Form<'a> {
    /// Its columns, in the order of a file without a header.
    pub(crate) columns: &'a [&'a str],
    /// How many of them a row has where no header names them; none: a header must be there.
    pub(crate) widths: &'a [usize],
    /// Where they are described, for messages.
    pub(crate) described: &'a str,
}

/// The columns of a file, by name.
pub(crate) struct Header<'a> {
    path: &'a Path,
    place: Place,
    described: &'a str,
    names: Vec<String>,
    /// How many cells a row may have.
    widths: Vec<usize>,
}

/// A CSV file that is read row by row. Lines that begin with `#` and blank ones are passed over.
pub(crate) struct Table<'a> {
    pub(crate) header: Header<'a>,
    text: &'a str,
    reader: csv::Reader<&'a [u8]>,
    record: StringRecord,
    /// The first row, where no header came before it.
    pending: bool,
}

/// A row that knows its place.
pub(crate) struct Row<'t> {
    header: &'t Header<'t>,
    record: &'t StringRecord,
    pub(crate) line: usize,
}

impl<'a> Table<'a> {
    /// Reads the header, or finds that there is none: then the first row holds a number, and columns are those of the form.
    /// A remark that names them, as numpy writes it, is a header too.
    ///
    /// # Errors
    /// Columns are not separated by commas, or one has no name, one that is not known, or that of another.
    pub(crate) fn open(text: &'a str, path: &'a Path, form: &Form<'a>) -> Result<Self> {
        let text = without_mark(text);
        // A line ends with its line feed, so that lines of Windows files are counted right.
        let reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .flexible(true)
            .comment(Some(b'#'))
            .terminator(csv::Terminator::Any(b'\n'))
            .trim(csv::Trim::All)
            .from_reader(text.as_bytes());
        let names = form.columns.iter().map(|name| (*name).to_owned()).collect();
        let header =
            Header { path, place: Place::Line(1), described: form.described, names, widths: form.widths.to_vec() };
        let mut table = Self { header, text, reader, record: StringRecord::new(), pending: false };
        let Some(line) = table.advance()? else { return Ok(table) };
        table.header.place = Place::Line(line);
        table.header.require_commas(&table.record)?;
        // Names are no numbers; but some programs count columns for want of names.
        let is_row = table.record.iter().any(|cell| cell.parse::<f64>().is_ok());
        let is_count = table.record.iter().enumerate().all(|(index, cell)| cell == index.to_string());
        if is_count && table.record.len() > 1 {
            return Err(table.header.broken("numbers 0, 1, 2, … for a header", form.described));
        }
        table.pending = is_row && !form.widths.is_empty();
        let named: Option<Vec<String>> = match table.pending {
            true => table.header.take_remark(text, table.record.len(), form),
            false => Some(table.record.iter().map(str::to_owned).collect()),
        };
        named.map_or(Ok(()), |named| table.header.take(named, form))?;
        Ok(table)
    }

    /// The next row; `None` after the last.
    ///
    /// # Errors
    /// It has another number of cells than the header, or a quote that is not closed.
    pub(crate) fn next(&mut self) -> Result<Option<Row<'_>>> {
        let line = match std::mem::take(&mut self.pending) {
            true => Some(self.line()),
            false => self.advance()?,
        };
        let Some(line) = line else { return Ok(None) };
        let row = Row { header: &self.header, record: &self.record, line };
        let cells = self.record.len();
        if !self.header.widths.contains(&cells) {
            let widths: Vec<String> = self.header.widths.iter().map(usize::to_string).collect();
            return Err(
                row.broken(format!("{cells} cells"), &format!("{}: {}", widths.join(" or "), self.header.described))
            );
        }
        Ok(Some(row))
    }

    /// Reads the next record that is neither blank nor a remark, and tells its line.
    fn advance(&mut self) -> Result<Option<usize>> {
        loop {
            let read = self.reader.read_record(&mut self.record);
            let broken = |found: String| {
                let expected = "a CSV file: cells separated by commas, quotes closed on their line";
                Error::malformed(self.header.path, Place::Line(self.line()), found, expected)
            };
            if !read.map_err(|error| broken(error.to_string()))? {
                return Ok(None);
            }
            if let Some(cell) = self.record.iter().find(|cell| cell.contains('\n')) {
                return Err(broken(format!("a quote that is not closed, {}", excerpt(cell))));
            }
            // Spreadsheets leave rows of commas alone.
            let is_blank = self.record.iter().all(str::is_empty);
            if !is_blank && !self.record[0].starts_with('#') {
                return Ok(Some(self.line()));
            }
        }
    }

    /// The line of the last record. Its position is that before the lines that were passed over.
    fn line(&self) -> usize {
        let Some(position) = self.record.position() else { return 1 };
        let skipped = self.text[position.byte() as usize..].lines().take_while(|line| is_passed_over(line)).count();
        position.line() as usize + skipped
    }
}

impl Header<'_> {
    /// That columns are separated as they should be.
    fn require_commas(&self, record: &StringRecord) -> Result<()> {
        let [only] = record.iter().collect::<Vec<_>>()[..] else { return Ok(()) };
        let separator =
            [(';', "semicolons"), ('\t', "tabs"), (' ', "blanks")].into_iter().find(|(mark, _)| only.contains(*mark));
        match separator {
            Some((_, marks)) => Err(self.broken(format!("columns separated by {marks}"), "commas")),
            None => Ok(()),
        }
    }

    /// The names in a remark before the first row: as many as the row has cells, or most of them known.
    fn take_remark(&mut self, text: &str, row_cells: usize, form: &Form) -> Option<Vec<String>> {
        remarks(text).find_map(|(place, remark)| {
            let remark = remark.trim_start_matches('#');
            let by_commas: Vec<&str> = remark.split(',').map(str::trim).collect();
            let cells = if by_commas.len() > 1 { by_commas } else { remark.split_whitespace().collect() };
            let known = cells.iter().filter(|cell| form.columns.contains(cell)).count();
            let named = known > 0 && cells.len() == row_cells || 3 * known > 2 * cells.len();
            (cells.len() > 2 && named).then(|| {
                self.place = place;
                cells.into_iter().map(str::to_owned).collect()
            })
        })
    }

    /// Takes the names that a file gives its columns.
    fn take(&mut self, named: Vec<String>, form: &Form) -> Result<()> {
        for (index, name) in named.iter().enumerate() {
            if name.is_empty() {
                let found = format!("no name of column {} of {}", index + 1, named.len());
                return Err(self.broken(found, &format!("{}; an index column? write the file without", self.described)));
            }
            if named[..index].contains(name) {
                return Err(self.broken(format!("a second column {}", excerpt(name)), "each column once"));
            }
            if !form.columns.contains(&name.as_str()) {
                return Err(self.broken(format!("an unknown column {}", excerpt(name)), self.described));
            }
        }
        // Where the first columns have names, those that may follow have their places.
        let follow = form.widths.iter().position(|&width| {
            width == named.len() && form.columns[..width].iter().all(|column| named.iter().any(|name| name == column))
        });
        self.widths = follow.map_or(vec![named.len()], |place| form.widths[place..].to_vec());
        let unnamed = follow.map_or(&[][..], |_| &form.columns[named.len()..]);
        self.names = named.into_iter().chain(unnamed.iter().map(|name| (*name).to_owned())).collect();
        Ok(())
    }

    /// The place of a column.
    pub(crate) fn position(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|column| column == name)
    }

    /// The places of columns that must be there.
    ///
    /// # Errors
    /// One is missing.
    pub(crate) fn require(&self, names: &[impl AsRef<str>]) -> Result<Vec<usize>> {
        let missing = |name: &str| self.broken(format!("no column `{name}`"), self.described);
        names.iter().map(|name| self.position(name.as_ref()).ok_or_else(|| missing(name.as_ref()))).collect()
    }

    /// The places of columns of which all are there, or none.
    ///
    /// # Errors
    /// Some are missing.
    pub(crate) fn group(&self, names: &[impl AsRef<str>]) -> Result<Option<Vec<usize>>> {
        let any = names.iter().any(|name| self.position(name.as_ref()).is_some());
        any.then(|| self.require(names)).transpose()
    }

    /// An error of the header itself.
    pub(crate) fn broken(&self, found: impl Into<String>, expected: &str) -> Error {
        Error::malformed(self.path, self.place.clone(), found, expected)
    }
}

impl<'t> Row<'t> {
    /// An error of this row.
    pub(crate) fn broken(&self, found: impl Into<String>, expected: &str) -> Error {
        Error::malformed(self.header.path, self.place(), found, expected)
    }

    /// The file.
    pub(crate) fn path(&self) -> &'t Path {
        self.header.path
    }

    /// Where it stands.
    pub(crate) fn place(&self) -> Place {
        Place::Line(self.line)
    }

    /// Name of a column.
    pub(crate) fn name(&self, column: usize) -> &'t str {
        &self.header.names[column]
    }

    /// What stands in a column; nothing where the row ends before it.
    pub(crate) fn cell(&self, column: usize) -> &'t str {
        self.record.get(column).unwrap_or_default()
    }

    /// Whether nothing stands there.
    pub(crate) fn is_empty(&self, column: usize) -> bool {
        self.cell(column).is_empty()
    }

    /// An error of a column.
    pub(crate) fn broken_cell(&self, column: usize, expected: &str) -> Error {
        let found = match self.cell(column) {
            "" => format!("nothing in column `{}`", self.name(column)),
            cell => format!("`{}` = {}", self.name(column), excerpt(cell)),
        };
        self.broken(found, expected)
    }

    /// A text that must be there.
    pub(crate) fn text(&self, column: usize) -> Result<&'t str> {
        match self.is_empty(column) {
            true => Err(self.broken_cell(column, "a name")),
            false => Ok(self.cell(column)),
        }
    }

    /// A frame index.
    pub(crate) fn frame(&self, column: usize) -> Result<usize> {
        match self.is_empty(column) {
            true => Err(self.broken_cell(column, "a frame number")),
            false => frame_index(self.cell(column), self.header.path, &self.place()),
        }
    }

    /// A finite number.
    pub(crate) fn number(&self, column: usize) -> Result<f64> {
        let value = self.cell(column).parse::<f64>().ok().filter(|value| value.is_finite());
        value.ok_or_else(|| self.broken_cell(column, "a finite number"))
    }

    /// A finite number, or nothing.
    pub(crate) fn optional(&self, column: usize) -> Result<Option<f64>> {
        if self.is_empty(column) { Ok(None) } else { self.number(column).map(Some) }
    }

    /// Numbers of several columns.
    pub(crate) fn numbers<const N: usize>(&self, columns: &[usize]) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        assert_eq!(columns.len(), N);
        for (number, &column) in numbers.iter_mut().zip(columns) {
            *number = self.number(column)?;
        }
        Ok(numbers)
    }

    /// Numbers of columns of which all hold something, or none.
    pub(crate) fn all_or_none<const N: usize>(&self, columns: &[usize]) -> Result<Option<[f64; N]>> {
        let any = columns.iter().any(|&column| !self.is_empty(column));
        any.then(|| self.numbers(columns)).transpose()
    }

    /// True or false; nothing is false.
    pub(crate) fn flag(&self, column: usize) -> Result<bool> {
        match self.cell(column).to_ascii_lowercase().as_str() {
            "true" | "1" | "yes" => Ok(true),
            "false" | "0" | "no" | "" => Ok(false),
            _ => Err(self.broken_cell(column, "true or false")),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const FORM: Form =
        Form { columns: &["frame", "x", "y", "std"], widths: &[3, 4], described: "frame,x,y and std (docs)" };

    /// Line, frame and x of each row.
    fn read(text: &str, form: &Form) -> Result<Vec<(usize, usize, f64)>> {
        let mut table = Table::open(text, Path::new("t.csv"), form)?;
        let [frame, x] = table.header.require(&["frame", "x"])?[..] else { unreachable!() };
        let mut rows = Vec::new();
        while let Some(row) = table.next()? {
            rows.push((row.line, row.frame(frame)?, row.number(x)?));
        }
        Ok(rows)
    }

    #[test]
    fn columns_have_their_names_or_their_places() {
        let rows = [(1, 4, 1.5)];
        assert_eq!(read("4,1.5,0\n", &FORM).unwrap(), rows);
        assert_eq!(read("\u{feff}4,\"1.5\",0,.1\r\n", &FORM).unwrap(), rows);
        assert_eq!(read("x,frame\n1.5,4\n", &FORM).unwrap(), [(2, 4, 1.5)]);
        // Names for the first ones alone.
        assert_eq!(read("y,x,frame\n0,1.5,4\n\n0,2.5,5,.1\n", &FORM).unwrap(), [(2, 4, 1.5), (4, 5, 2.5)]);
        assert_eq!(
            read("\n \n,,\n# a \"remark\n  # another, indented\n\nframe,x\n# more\n\n4,1.5\n", &FORM).unwrap(),
            [(10, 4, 1.5)]
        );
        // As numpy.savetxt writes its header.
        assert_eq!(read("# x, frame, y\n1.5,4,0\n", &FORM).unwrap(), [(2, 4, 1.5)]);
        assert_eq!(read("# of Monday: x, y\n4,1.5,0\n# he said, \"so\n5,1.5,0\n", &FORM).unwrap().len(), 2);
        assert_eq!(read("", &FORM).unwrap(), []);
    }

    #[test]
    fn what_is_wrong_is_named_where_it_stands() {
        for (text, words) in [
            ("4,,0\n", "line 1: found nothing in column `x`; expected a finite number"),
            ("frame,x\n\n4,\n", "line 3: found nothing in column `x`"),
            (",1,0\n", "line 1: found nothing in column `frame`"),
            ("4,1\n", "line 1: found 2 cells; expected 3 or 4: frame,x,y and std"),
            ("# x, frame, lat\n1.5,4,0\n", "line 1: found an unknown column `lat`"),
            ("0,1,2\n4,1,0\n", "line 1: found numbers 0, 1, 2, … for a header"),
            ("frame,x\n4, \"1.5\"\n", "line 2: found `x` = `\"1.5\"`"),
            ("frame,x\n4,1,2\n", "line 2: found 3 cells; expected 2: "),
            ("frame,x\n4,inf\n", "line 2: found `x` = `inf`"),
            ("frame;x\n4;1\n", "line 1: found columns separated by semicolons; expected commas"),
            ("4\t1\t0\n", "line 1: found columns separated by tabs"),
            ("4 1 0\n", "line 1: found columns separated by blanks"),
            (",frame,x\n0,4,1\n", "line 1: found no name of column 1 of 3"),
            ("frame,x,x\n4,1,1\n", "line 1: found a second column `x`"),
            ("# one\nframe,lat\n", "line 2: found an unknown column `lat`; expected frame,x,y and std (docs)"),
            ("frame,y\n4,1\n", "line 1: found no column `x`"),
            ("frame,x\n4,\"1\n5,2\n6,3\n", "line 2: found a quote that is not closed, `1\\n5,2\\n6,3`"),
        ] {
            let message = read(text, &FORM).unwrap_err().to_string();
            assert!(message.contains(words), "{message}\nexpected: {words}");
        }
        let named = Form { widths: &[], ..FORM };
        assert!(read("4,1,0\n", &named).unwrap_err().to_string().contains("line 1: found an unknown column `4`"));
    }

    proptest! {
        #[test]
        fn no_text_makes_the_reader_panic(text in "(frame|x|std|,|\n|\r|1|NaN|\"|#| |;){0,40}") {
            let _ = read(&text, &FORM);
        }
    }
}
