//! An example of every operation, written into the OpenAPI document: parameters, body, and what comes back.
//!
//! They lie in examples.json under the operation's id; `tests/python/test_examples.py` sends each to the binary and holds
//! the answers, its own and the written ones, against the schemas. The document is changed as JSON, because utoipa's
//! types do not give access to a parameter's example.

use serde_json::{Map, Value};
use utoipa::openapi::OpenApi;

/// By operation id: `parameters` by name, `request` by media type, `answers` by status and media type.
const EXAMPLES: &str = include_str!("examples.json");

/// Adds its example to every operation.
pub(super) fn illustrate(document: &mut OpenApi) {
    let examples: Map<String, Value> = serde_json::from_str(EXAMPLES).unwrap_or_default();
    let Ok(mut whole) = serde_json::to_value(&*document) else { return };
    let paths = whole["paths"].as_object_mut().into_iter().flat_map(|paths| paths.values_mut());
    for operation in paths.filter_map(Value::as_object_mut).flat_map(|item| item.values_mut()) {
        let example = operation["operationId"].as_str().and_then(|id| examples.get(id));
        if let Some(example) = example.cloned() {
            illustrated(operation, &example);
        }
    }
    // What went out of these types comes back into them.
    if let Ok(told) = serde_json::from_value(whole) {
        *document = told;
    }
}

fn illustrated(operation: &mut Value, example: &Value) {
    for parameter in operation.get_mut("parameters").and_then(Value::as_array_mut).into_iter().flatten() {
        let value = parameter["name"].as_str().and_then(|name| example["parameters"].get(name));
        if let Some(value) = value.cloned() {
            parameter["example"] = value;
        }
    }
    let contents = |of: &Value| of.as_object().cloned().unwrap_or_default();
    for (kind, value) in contents(&example["request"]) {
        shown(operation.pointer_mut("/requestBody/content"), &kind, value);
    }
    for (status, answers) in contents(&example["answers"]) {
        for (kind, value) in contents(&answers) {
            shown(operation.pointer_mut(&format!("/responses/{status}/content")), &kind, value);
        }
    }
}

fn shown(content: Option<&mut Value>, kind: &str, value: Value) {
    if let Some(content) = content.and_then(|content| content.get_mut(kind)) {
        content["example"] = value;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_operation_has_an_example_and_every_example_an_operation() {
        let examples: Map<String, Value> = serde_json::from_str(EXAMPLES).unwrap();
        let document = serde_json::to_value(crate::http::openapi()).unwrap();
        let items = document["paths"].as_object().unwrap().values();
        let operations = items.flat_map(|item| item.as_object().unwrap().values());
        let mut ids: Vec<&str> = operations.filter_map(|operation| operation["operationId"].as_str()).collect();
        let mut named: Vec<&str> = examples.keys().map(String::as_str).collect();
        ids.sort_unstable();
        named.sort_unstable();
        assert_eq!(ids, named);
        // What is named lies where the document has a place for it.
        let text = document.to_string();
        assert_eq!(text.matches("\"example\":").count(), 1 + count(&examples), "an example has no place");
    }

    /// Parameters, bodies and answers of all examples (the one more is a field's own, of NewWebhook).
    fn count(examples: &Map<String, Value>) -> usize {
        let members = |value: &Value| value.as_object().map_or(0, Map::len);
        let answers = |value: &Value| value.as_object().map_or(0, |all| all.values().map(members).sum());
        examples.values().map(|e| members(&e["parameters"]) + members(&e["request"]) + answers(&e["answers"])).sum()
    }
}
