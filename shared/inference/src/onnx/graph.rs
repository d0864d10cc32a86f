//! Builds a graph of operators, from its input to its outputs.

use super::proto::{
    Attribute, AttributeType, DataType, Dimension, Extent, Graph, GraphNode, Model, OperatorSet, Shape, Tensor,
    TensorType, Value, ValueType,
};
use ndarray::ArrayD;
use prost::Message as _;

/// Version of the file format, and of the operators: the first that have `Gelu` and `GroupNormalization` by channel.
const IR_VERSION: i64 = 10;
const OPERATORS: i64 = 21;

/// The name of a value in the graph.
pub type Name = String;

/// A graph under construction. Each operator returns the name of its result.
#[derive(Debug, Default)]
pub struct Builder {
    graph: Graph,
}

impl Builder {
    /// Adds an operator with one result.
    pub fn node(&mut self, operator: &str, inputs: &[&str], attributes: Vec<Attribute>) -> Name {
        self.outputs(operator, inputs, attributes, 1).remove(0)
    }

    /// Adds an operator with `count` results.
    pub fn outputs(&mut self, operator: &str, inputs: &[&str], attributes: Vec<Attribute>, count: usize) -> Vec<Name> {
        let name = format!("{operator}_{}", self.graph.node.len());
        let output: Vec<Name> = (0..count).map(|i| format!("{name}_{i}")).collect();
        self.graph.node.push(GraphNode {
            input: inputs.iter().map(|&i| i.to_owned()).collect(),
            output: output.clone(),
            name,
            op_type: operator.to_owned(),
            attribute: attributes,
        });
        output
    }

    /// Adds weights.
    pub fn weights(&mut self, name: &str, values: &ArrayD<f32>) -> Name {
        let dims = values.shape().iter().map(|&n| n as i64).collect();
        let raw_data = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(name, dims, DataType::Float, raw_data)
    }

    /// Adds a number.
    pub fn number(&mut self, value: f32) -> Name {
        let name = format!("number_{}", self.graph.initializer.len());
        self.tensor(&name, Vec::new(), DataType::Float, value.to_le_bytes().to_vec())
    }

    /// Adds a list of integers, such as a shape.
    pub fn integers(&mut self, values: &[i64]) -> Name {
        let name = format!("integers_{}", self.graph.initializer.len());
        let raw_data = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.tensor(&name, vec![values.len() as i64], DataType::Int64, raw_data)
    }

    fn tensor(&mut self, name: &str, dims: Vec<i64>, kind: DataType, raw_data: Vec<u8>) -> Name {
        self.graph.initializer.push(Tensor { dims, data_type: kind.into(), name: name.to_owned(), raw_data });
        name.to_owned()
    }

    /// Returns `x * factor + shift`.
    pub fn scaled(&mut self, x: &str, factor: f32, shift: f32) -> Name {
        let factor = self.number(factor);
        let x = self.node("Mul", &[x, &factor], Vec::new());
        let shift = self.number(shift);
        self.node("Add", &[&x, &shift], Vec::new())
    }

    /// Limits values to `low..=high`.
    pub fn clip(&mut self, x: &str, low: f32, high: f32) -> Name {
        let (low, high) = (self.number(low), self.number(high));
        self.node("Clip", &[x, &low, &high], Vec::new())
    }

    /// Reshapes a value; a zero keeps the dimension, and -1 takes what is left.
    pub fn reshape(&mut self, x: &str, shape: &[i64]) -> Name {
        let shape = self.integers(shape);
        self.node("Reshape", &[x, &shape], Vec::new())
    }

    /// Permutes the dimensions.
    pub fn transpose(&mut self, x: &str, order: &[i64]) -> Name {
        self.node("Transpose", &[x], vec![ints("perm", order)])
    }

    /// Ends the graph, and returns the bytes of the ONNX file.
    pub fn finish(mut self, name: &str, doc: &str, input: Value, outputs: &[(&str, &str, i64)]) -> Vec<u8> {
        for &(value, output, width) in outputs {
            if let Some(last) = self.graph.node.iter_mut().flat_map(|node| &mut node.output).find(|o| *o == value) {
                output.clone_into(last);
            }
            self.graph.output.push(described(output, DataType::Float, vec![Extent::Fixed(1), Extent::Fixed(width)]));
        }
        name.clone_into(&mut self.graph.name);
        self.graph.input.push(input);
        let model = Model {
            ir_version: IR_VERSION,
            producer_name: "carff".to_owned(),
            doc_string: doc.to_owned(),
            graph: Some(self.graph),
            opset_import: vec![OperatorSet { domain: String::new(), version: OPERATORS }],
        };
        model.encode_to_vec()
    }
}

/// Describes an input or output of a graph.
pub fn described(name: &str, kind: DataType, extents: Vec<Extent>) -> Value {
    let dimension = extents.into_iter().map(|extent| Dimension { extent: Some(extent) }).collect();
    let tensor = TensorType { element: kind.into(), shape: Some(Shape { dimension }) };
    Value { name: name.to_owned(), kind: Some(ValueType { tensor: Some(tensor) }) }
}

/// An attribute with integers.
pub fn ints(name: &str, values: &[i64]) -> Attribute {
    Attribute { ints: values.to_vec(), ..attribute(name, AttributeType::Ints) }
}

/// An attribute with one integer.
pub fn int(name: &str, value: i64) -> Attribute {
    Attribute { i: Some(value), ..attribute(name, AttributeType::Int) }
}

/// An attribute with a number.
pub fn float(name: &str, value: f32) -> Attribute {
    Attribute { f: Some(value), ..attribute(name, AttributeType::Float) }
}

/// An attribute with text.
pub fn text(name: &str, value: &str) -> Attribute {
    Attribute { s: Some(value.as_bytes().to_vec()), ..attribute(name, AttributeType::String) }
}

fn attribute(name: &str, kind: AttributeType) -> Attribute {
    Attribute { name: name.to_owned(), kind: kind.into(), ..Attribute::default() }
}
