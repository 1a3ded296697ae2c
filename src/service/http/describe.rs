//! What every operation may answer beside its own answers, written into the OpenAPI document in one place.
//!
//! A key can be missing, lack the role or meet its rate, and the database can be away, at every call; a query or a body
//! can be broken wherever there is one. Named here instead of at each handler, so that a new call cannot forget them
//! (schemathesis found 25 answers that the document did not know).

use utoipa::openapi::path::{Operation, Parameter, ParameterIn};
use utoipa::openapi::schema::{Schema, SchemaType, Type};
use utoipa::openapi::{ContentBuilder, OpenApi, Ref, RefOr, Response, ResponseBuilder};

/// Answers of every call that needs a key.
const WITH_KEY: &[(&str, &str)] = &[
    ("401", "The key or token is missing, unknown, revoked or out of date"),
    ("403", "The role may not do that"),
    ("429", "The key has met its rate; see Retry-After"),
    ("503", "The database or the store does not answer; see Retry-After"),
];
/// Answers of every call with a query.
const WITH_QUERY: &[(&str, &str)] = &[("400", "The query cannot be understood")];
/// Answers of every call with a body.
const WITH_BODY: &[(&str, &str)] = &[
    ("400", "The body cannot be understood"),
    ("413", "The body is larger than this call takes"),
    ("415", "This call does not take that Content-Type"),
    ("422", "The body's content is at fault"),
];

/// Adds to every operation the answers that it shares with others; its own descriptions stand.
pub(super) fn complete(document: &mut OpenApi) {
    for item in document.paths.paths.values_mut() {
        let operations = [
            &mut item.get,
            &mut item.put,
            &mut item.post,
            &mut item.delete,
            &mut item.head,
            &mut item.patch,
            &mut item.options,
        ];
        operations.into_iter().flatten().for_each(add);
    }
}

fn add(operation: &mut Operation) {
    operation.parameters.iter_mut().flatten().for_each(not_null);
    let parameters = operation.parameters.iter().flatten();
    let mut asks = parameters.filter(|p| matches!(p, RefOr::T(p) if p.parameter_in == ParameterIn::Query));
    let sets = [
        (operation.security.is_some(), WITH_KEY),
        (asks.next().is_some(), WITH_QUERY),
        (operation.request_body.is_some(), WITH_BODY),
    ];
    for (status, words) in sets.into_iter().filter(|(has, _)| *has).flat_map(|(_, set)| set) {
        let answers = &mut operation.responses.responses;
        answers.entry((*status).to_owned()).or_insert_with(|| RefOr::T(problem(words)));
    }
}

/// A header that may be left out has no null: the text `null` would be read as its value.
fn not_null(parameter: &mut RefOr<Parameter>) {
    let RefOr::T(Parameter {
        parameter_in: ParameterIn::Header, schema: Some(RefOr::T(Schema::Object(schema))), ..
    }) = parameter
    else {
        return;
    };
    if let SchemaType::Array(types) = &mut schema.schema_type {
        types.retain(|each| *each != Type::Null);
        if let [only] = &types[..] {
            schema.schema_type = SchemaType::Type(only.clone());
        }
    }
}

fn problem(words: &str) -> Response {
    let content = ContentBuilder::new().schema(Some(Ref::from_schema_name("Problem"))).build();
    ResponseBuilder::new().description(words).content(crate::error::PROBLEM_JSON, content).build()
}
