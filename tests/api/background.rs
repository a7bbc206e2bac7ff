//! What lies below the page's map: a picture, tiles, and nothing outside of what is configured.

use oapwatch::api::{Background, Config};
use oapwatch::geo::{Geodetic, LocalAxes};
use reqwest::{Client, header};

use crate::fake::{Fake, get, json_of, problem};

const PNG: &[u8] = b"\x89PNG\r\n\x1a\nsmall";

fn axes() -> LocalAxes {
    LocalAxes::at(Geodetic {
        latitude_deg: 48.137,
        longitude_deg: 11.575,
        height_m: 520.0,
    })
}

async fn start(config: Config) -> Fake {
    let background = Background::open(&config.background, Some(&axes())).unwrap();
    Fake::with(config, |state| state.with_background(background)).await
}

#[tokio::test]
async fn without_a_background_there_is_none() {
    let fake = start(Config::default()).await;
    assert_eq!(json_of(get(&fake, "/v1/background").await).await, serde_json::json!({}));
    problem(get(&fake, "/v1/background/picture").await, 404).await;
    problem(get(&fake, "/v1/background/tiles/3/5/2").await, 404).await;
    fake.stop().await;
}

#[tokio::test]
async fn a_picture_has_corners_and_comes_once() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = Config::default();
    config.background.picture = Some(folder.path().join("yard.png"));
    config.background.corners_m = Some([[-9.0, 9.0], [9.0, 9.0], [-9.0, -9.0]]);
    std::fs::write(folder.path().join("yard.png"), "<svg/>").unwrap();
    let refused = Background::open(&config.background, None).err().unwrap().to_string();
    assert!(
        refused.contains("yard.png") && refused.contains("PNG, JPEG or WebP"),
        "{refused}"
    );
    std::fs::write(folder.path().join("yard.png"), PNG).unwrap();
    let fake = start(config).await;
    let shown = json_of(get(&fake, "/v1/background").await).await;
    assert_eq!(shown["picture"]["corners_m"][1], serde_json::json!([9.0, 9.0]));
    let picture = get(&fake, "/v1/background/picture").await;
    assert_eq!(picture.headers()[header::CONTENT_TYPE], "image/png");
    let tag = picture.headers()[header::ETAG].clone();
    assert_eq!(picture.bytes().await.unwrap(), PNG);
    let again = Client::new()
        .get(fake.url("/v1/background/picture"))
        .header(header::IF_NONE_MATCH, tag);
    assert_eq!(again.send().await.unwrap().status(), 304);
    fake.stop().await;
}

#[tokio::test]
async fn tiles_come_from_their_folder_only() {
    let folder = tempfile::tempdir().unwrap();
    let tiles = folder.path().join("tiles");
    std::fs::create_dir_all(tiles.join("3/5")).unwrap();
    std::fs::write(tiles.join("3/5/2.png"), PNG).unwrap();
    std::fs::write(folder.path().join("secret.png"), PNG).unwrap();
    let mut config = Config::default();
    config.background.tiles = Some(tiles);
    config.background.attribution = Some("© surveyors".into());
    let fake = start(config).await;
    let shown = json_of(get(&fake, "/v1/background").await).await;
    assert_eq!(shown["tiles"]["min_zoom"], 3);
    assert_eq!(shown["attribution"], "© surveyors");
    let tile = get(&fake, "/v1/background/tiles/3/5/2").await;
    assert_eq!(tile.headers()[header::CONTENT_TYPE], "image/png");
    assert_eq!(tile.bytes().await.unwrap(), PNG);
    for (path, status) in [
        ("3/5/3", 404),
        ("3/5/9999", 404),
        ("99/5/3", 404),
        ("3/5/..%2f..%2f..%2fsecret", 400),
        ("3/-1/0", 400),
    ] {
        problem(get(&fake, &format!("/v1/background/tiles/{path}")).await, status).await;
    }
    fake.stop().await;
}
