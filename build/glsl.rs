//! What the text of a shader says and its SPIR-V does not: constants, and the comment of each declaration.

use std::collections::BTreeMap;

use super::compiler;

/// The block that the arrays of all buffers are members of.
pub(crate) const BUFFER: &str = "buffer";

/// A `const` of a type that the host has too.
pub(crate) struct Constant {
    name: String,
    ty: &'static str,
    /// One, or the elements of an array.
    values: Vec<String>,
    is_array: bool,
    comment: String,
}

/// The constants of one shader or include, and the comments of its blocks' members.
#[derive(Default)]
pub(crate) struct Text {
    pub(crate) constants: Vec<Constant>,
    /// By block (`Params`, a struct, [`BUFFER`]) and member; specialization constants are in block "".
    comments: BTreeMap<(String, String), String>,
}

impl Text {
    /// The comment after a declaration, or in the lines above it.
    pub(crate) fn comment(&self, block: &str, member: &str) -> &str {
        self.comments.get(&(block.to_owned(), member.to_owned())).map_or("", String::as_str)
    }

    /// The constants as Rust.
    pub(crate) fn own_constants(&self) -> String {
        self.constants.iter().map(ToString::to_string).collect()
    }

    /// Takes over the comments of another text.
    pub(crate) fn add_comments(&mut self, other: Self) {
        self.comments.extend(other.comments);
    }

    /// Reads the source alone, without what it includes.
    pub(crate) fn read(source: &str) -> Self {
        let mut text = Self::default();
        let (mut block, mut above, mut lines) = (None, vec![], source.lines());
        while let Some(line) = lines.next() {
            let (mut code, mut comment) = split_comment(line);
            if code.is_empty() {
                if comment.is_empty() {
                    above.clear();
                } else {
                    above.push(comment);
                }
                continue;
            }
            let is_declaration = line.starts_with("const ") || line.starts_with("layout(");
            while is_declaration && !code.contains([';', '{']) {
                let (more, after) = split_comment(lines.next().expect("a declaration ends"));
                code += &more;
                comment += &after;
            }
            if comment.is_empty() {
                comment = above.join(" ");
            }
            above.clear();
            if let Some((name, members)) = block_of(line) {
                match members.split_once('}') {
                    Some((members, _)) => text.add_member(name, members, comment),
                    None => block = Some(name),
                }
            } else if code.starts_with('}') {
                block = None;
            } else if let Some(block) = block {
                text.add_member(block, &code, comment);
            } else if let Some((_, specialised)) = code.split_once(" const ") {
                let (declaration, _) = specialised.split_once('=').expect("it has a default");
                text.add_member("", declaration, comment);
            } else if let Some(declared) = code.strip_prefix("const ").filter(|_| is_declaration) {
                text.add_constants(declared, &comment);
            }
        }
        text
    }

    /// Reads the source and, for comments, all that it includes.
    pub(crate) fn read_with_includes(source: &str) -> Self {
        let mut text = Self::read(source);
        let name =
            |line: &'_ str| line.strip_prefix("#include \"")?.strip_suffix('"').map(str::to_owned);
        for name in source.lines().filter_map(name) {
            let (_, included) = compiler::include(&name).expect("the compiler found it");
            text.add_comments(Self::read_with_includes(&included));
        }
        text
    }

    /// `type name;` or `type name[n];`
    fn add_member(&mut self, block: &str, declaration: &str, comment: String) {
        let declaration = declaration.split([';', '[']).next().unwrap_or_default();
        let member = declaration.split_whitespace().last().unwrap_or_default();
        if !comment.is_empty() {
            self.comments.insert((block.to_owned(), member.to_owned()), comment);
        }
    }

    /// `type name = value, name = value;` or `type name[n] = type[](value, value);`, where all that values name is
    /// known.
    fn add_constants(&mut self, declared: &str, comment: &str) {
        const TYPES: [(&str, &str); 3] = [("uint ", "u32"), ("int ", "i32"), ("float ", "f64")];
        let declared = declared.trim_end_matches(';');
        let of_type = |(glsl, ty)| declared.strip_prefix(glsl).map(|list| (ty, list));
        let Some((ty, list)) = TYPES.into_iter().find_map(of_type) else { return };
        let is_array = list.contains("[](");
        let constants = match list.split_once("[](") {
            Some((name, elements)) => vec![(name, elements.trim_end_matches(')'))],
            None => list.split(',').filter_map(|one| one.split_once('=')).collect(),
        };
        for (name, values) in constants {
            let name = name.split(['[', '=']).next().unwrap_or_default().trim().to_owned();
            let values = values.split(',').map(|value| self.to_rust(value.trim(), ty));
            if let Some(values) = values.collect() {
                let comment = comment.to_owned();
                self.constants.push(Constant { name, ty, values, is_array, comment });
            }
        }
    }

    /// A value with Rust's suffixes and conversions; nothing where it names what only the shader knows.
    fn to_rust(&self, value: &str, ty: &str) -> Option<String> {
        let is_word = |c: char| c.is_alphanumeric() || c == '_' || c == '.';
        let word = |word: &str| match word.starts_with(|c: char| c.is_ascii_digit()) {
            true => Some(word.trim_end_matches('u').to_owned()),
            false => {
                let is_known = self.constants.iter().any(|constant| constant.name == word);
                is_known.then(|| format!("({word} as {ty})"))
            }
        };
        let (mut rust, mut rest) = (String::new(), value);
        while let Some(begin) = rest.find(is_word) {
            let (operator, after) = rest.split_at(begin);
            let (found, after) = after.split_at(after.find(|c| !is_word(c)).unwrap_or(after.len()));
            rust = rust + operator + &word(found)?;
            rest = after;
        }
        Some(rust + rest)
    }
}

impl std::fmt::Display for Constant {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, ty, values, is_array, comment } = self;
        let (ty, value) = match (is_array, values.join(", ")) {
            (true, list) => (format!("[{ty}; {}]", values.len()), format!("[{list}]")),
            (false, value) => ((*ty).to_owned(), value),
        };
        writeln!(
            f,
            "{}pub const {name}: {ty} = {value};",
            rustdoc(comment, &format!("`{name}` of the shader."))
        )
    }
}

/// The includes' constants, a module each, so that host and shaders cannot hold different ones.
pub(crate) fn include_modules() -> String {
    let modules = compiler::includes().into_iter().filter_map(|(name, source)| {
        let constants: String =
            Text::read(&source).constants.iter().map(ToString::to_string).collect();
        let head: Vec<String> =
            source.lines().map_while(|line| line.strip_prefix("//")).map(str::to_owned).collect();
        let docs = rustdoc(&head.join("\n"), "");
        (!constants.is_empty()).then(|| format!("{docs}pub mod {name} {{\n{constants}}}\n\n"))
    });
    modules.collect()
}

/// A comment as documentation, or else `missing`.
pub(crate) fn rustdoc(comment: &str, missing: &str) -> String {
    let comment = if comment.is_empty() { missing } else { comment };
    let escaped = comment.replace('[', "\\[").replace(']', "\\]").replace('<', "\\<");
    escaped.lines().map(|line| format!("/// {}\n", line.trim())).collect()
}

fn split_comment(line: &str) -> (String, String) {
    let (code, comment) = line.split_once("//").unwrap_or((line, ""));
    (code.trim().to_owned(), comment.trim().to_owned())
}

/// The name of a block that the line begins, and what follows: a struct, the push constants, [`BUFFER`].
fn block_of(line: &str) -> Option<(&str, &str)> {
    let (head, members) = line.split_once('{')?;
    let mut words = head.split_whitespace();
    if words.clone().any(|word| word == BUFFER) {
        return Some((BUFFER, members));
    }
    let is_block = head.starts_with("struct ") || words.clone().any(|word| word == "uniform");
    words.next_back().filter(|_| is_block).map(|name| (name, members))
}
