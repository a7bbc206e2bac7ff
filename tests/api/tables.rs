//! Alerts and history as CSV.

use oapwatch::api::Config;
use reqwest::{Client, StatusCode, header};
use serde_json::{Value, json};

use crate::fake::{Fake, get, problem};

#[tokio::test]
async fn alerts_and_history_are_tables_for_spreadsheets() {
    let fake = Fake::start(Config::default()).await;
    let table = async |path: &str| {
        let answer = get(&fake, path).await;
        assert_eq!(answer.status(), StatusCode::OK, "{path}");
        let kind = answer.headers()[header::CONTENT_TYPE].to_str().unwrap().to_owned();
        assert!(kind.starts_with("text/csv"), "{kind}");
        let disposition = answer.headers()[header::CONTENT_DISPOSITION].to_str().unwrap();
        assert!(disposition.contains(".csv"), "{disposition}");
        let text = answer.text().await.unwrap();
        assert!(
            text.ends_with("\r\n") && !text.replace("\r\n", "").contains('\n'),
            "{text}"
        );
        let mut rows = csv::Reader::from_reader(text.as_bytes());
        let names = rows.headers().unwrap().clone();
        let rows: Vec<Value> = rows
            .records()
            .map(|row| {
                names
                    .iter()
                    .zip(row.unwrap().iter())
                    .map(|(n, c)| (n.to_owned(), json!(c)))
                    .collect()
            })
            .collect();
        rows
    };
    assert!(table("/v1/alerts.csv").await.is_empty());
    // More than the journal gives at once.
    for k in 0..1005 {
        fake.raise_at_once(&format!("n-{k}"));
    }
    fake.journal.settled().await;
    let all = table("/v1/alerts.csv").await;
    let ids: std::collections::BTreeSet<&str> = all.iter().map(|row| row["id"].as_str().unwrap()).collect();
    assert_eq!((all.len(), ids.len()), (1005, 1005));
    assert_eq!(
        (&all[0]["x_m"], &all[0]["cov_yy_m2"]),
        (&json!("-40.0"), &json!("0.01")),
        "a number is no formula"
    );
    assert_eq!((&all[0]["user"], &all[0]["cleared_at"]), (&json!(""), &json!("")));
    let evidence: Value = serde_json::from_str(all[0]["evidence"].as_str().unwrap()).unwrap();
    assert_eq!(evidence["seconds_seen"], 1.0);
    assert!(table("/v1/alerts.csv?kind=sensor_lost").await.is_empty());
    problem(get(&fake, "/v1/alerts.csv?state=no").await, 400).await;

    let note = json!({"note": "=HYPERLINK(\"http://evil.example\",\"click\")"});
    let acknowledge = Client::new()
        .post(fake.url("/v1/alerts/n-1/acknowledge"))
        .body(note.to_string());
    assert_eq!(acknowledge.send().await.unwrap().status(), StatusCode::OK);
    let row = table("/v1/alerts.csv?state=acknowledged").await.remove(0);
    assert_eq!(
        row["note"], "'=HYPERLINK(\"http://evil.example\",\"click\")",
        "defused, and quoted as CSV asks"
    );

    fake.step(1);
    fake.step(2);
    let beams = table("/v1/history.csv").await;
    assert_eq!(beams.len(), 6, "two moments of three beams");
    assert_eq!(
        (&beams[1]["user"], &beams[1]["status"], &beams[1]["x_m"]),
        (&json!("u-2"), &json!("mismatch"), &json!("55.0"))
    );
    assert_eq!(table("/v1/history.csv?limit=1").await.len(), 3);
    fake.stop().await;
}
