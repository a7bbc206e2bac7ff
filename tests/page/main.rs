//! The page in a real browser on the real daemon: an eavesdropper appears, is acknowledged, is gone; the daemon restarts.

mod browser;
#[path = "../daemon/port.rs"]
mod port;

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use browser::Browser;
use port::free_port;

/// The built-in scene's eavesdropper comes after five seconds and stays for eight, every half minute.
const PATIENCE: Duration = Duration::from_secs(45);

struct Daemon(Child);

impl Daemon {
    fn start(config: &Path) -> Self {
        let child = Command::new(env!("CARGO_BIN_EXE_oapwatch"))
            .args(["run", "--config"])
            .arg(config)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("the daemon starts");
        Self(child)
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn until(browser: &mut Browser, what: &str, condition: &str) {
    let started = Instant::now();
    while browser.eval(condition).await != true {
        assert!(started.elapsed() < PATIENCE, "{what}: {condition} never came true");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test]
async fn an_eavesdropper_comes_is_acknowledged_and_goes_and_a_restart_is_survived() {
    let dir = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let config = dir.path().join("oapwatch.toml");
    let text = format!(
        "[api]\nlisten = \"127.0.0.1:{port}\"\n[journal]\npath = \"journal.db\"\n[record]\nfolder = \"recordings\"\n"
    );
    std::fs::write(&config, text).expect("the config is written");
    let daemon = Daemon::start(&config);
    let Some(mut page) = Browser::open(&dir.path().join("profile"), &format!("http://127.0.0.1:{port}/")).await else {
        return;
    };

    until(
        &mut page,
        "the page is live",
        "document.getElementById('link').textContent === 'live'",
    )
    .await;
    until(
        &mut page,
        "users are verified",
        "document.querySelectorAll('#map .beam.verified').length >= 3",
    )
    .await;
    let card = "#list li.unclaimed_emitter.open";
    until(
        &mut page,
        "the eavesdropper is listed",
        &format!("!!document.querySelector('{card}')"),
    )
    .await;
    until(
        &mut page,
        "and drawn",
        "!!document.querySelector('#map .beam.unclaimed .ping')",
    )
    .await;
    until(
        &mut page,
        "the frame is shown",
        "document.getElementById('frame').naturalWidth >= 512",
    )
    .await;
    page.screenshot("eavesdropper").await;

    until(
        &mut page,
        "its severity is said in a word",
        &format!("document.querySelector('{card} .severity').textContent.length > 3"),
    )
    .await;
    until(
        &mut page,
        "and its evidence in sentences",
        &format!("/seen for .* without a claim/.test(document.querySelector('{card} .evidence').textContent)"),
    )
    .await;
    until(
        &mut page,
        "with a picture",
        &format!("document.querySelector('{card} .thumbnail img').naturalWidth >= 256"),
    )
    .await;
    page.eval(&format!("document.querySelector('{card} details.numbers').open = true"))
        .await;
    until(
        &mut page,
        "with its model and residual beside",
        &format!("document.querySelector('{card} .fit img').naturalWidth > 3 * 512"),
    )
    .await;
    page.eval("document.querySelector('.fit').scrollIntoView({ block: 'center' })")
        .await;
    page.screenshot("fit").await;
    until(
        &mut page,
        "the reader is warned of the simulator",
        "document.getElementById('notices').textContent.includes('no camera is watched')",
    )
    .await;
    page.eval(&format!(
        "document.querySelector('{card} .note').value = 'unit 3 goes'; document.querySelector('{card} .acts button').click()"
    ))
    .await;
    let acknowledged = "!!document.querySelector('#list li.unclaimed_emitter.acknowledged')";
    until(&mut page, "the acknowledgement is shown", acknowledged).await;
    until(
        &mut page,
        "with its note",
        "document.querySelector('#list .acknowledgement').textContent.includes('unit 3 goes')",
    )
    .await;
    page.eval("document.querySelector('#list li.acknowledged .acts button').click()")
        .await;
    until(&mut page, "and undone", &format!("!!document.querySelector('{card}')")).await;
    page.eval("const r = document.getElementById('moment'); r.value = 1; r.dispatchEvent(new Event('input'))")
        .await;
    until(
        &mut page,
        "the past is named",
        "document.getElementById('link').textContent === 'looking back' && !document.getElementById('past-banner').hidden",
    )
    .await;
    page.eval("document.getElementById('present').click()").await;
    until(
        &mut page,
        "the eavesdropper goes",
        "!document.querySelector('#list li.unclaimed_emitter')",
    )
    .await;
    page.eval("document.getElementById('past').click()").await;
    until(
        &mut page,
        "its alert is history",
        "!!document.querySelector('#list li.unclaimed_emitter.cleared')",
    )
    .await;

    drop(daemon);
    until(
        &mut page,
        "the loss is said",
        "document.getElementById('link').textContent === 'disconnected'",
    )
    .await;
    until(&mut page, "in words", "!document.getElementById('banner').hidden").await;
    let _daemon = Daemon::start(&config);
    until(
        &mut page,
        "the page comes back",
        "document.getElementById('link').textContent === 'live'",
    )
    .await;
    until(
        &mut page,
        "with what was",
        "!!document.querySelector('#list li.unclaimed_emitter.cleared')",
    )
    .await;
    assert_eq!(page.errors(), Vec::<String>::new());
}

#[tokio::test]
async fn a_picture_lies_below_a_platform_that_moves() {
    let dir = tempfile::tempdir().expect("a folder");
    let port = free_port();
    let mut png = png::Encoder::new(
        std::fs::File::create(dir.path().join("yard.png")).expect("a file"),
        2,
        2,
    );
    png.set_color(png::ColorType::Grayscale);
    let mut writer = png.write_header().expect("a header");
    writer.write_image_data(&[90, 200, 200, 90]).expect("four pixels");
    writer.finish().expect("the picture is written");
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/config/scenes/flight.toml");
    let config = dir.path().join("oapwatch.toml");
    let text = format!(
        "[source]\nscene = {scene:?}\n[api]\nlisten = \"127.0.0.1:{port}\"\n[api.background]\npicture = \"yard.png\"\n\
         corners_m = [[-140.0, 100.0], [130.0, 140.0], [-140.0, -100.0]]\nattribution = \"surveyors\"\n"
    );
    std::fs::write(&config, text).expect("the config is written");
    let _daemon = Daemon::start(&config);
    let Some(mut page) = Browser::open(&dir.path().join("profile"), &format!("http://127.0.0.1:{port}/")).await else {
        return;
    };
    let shown = [
        (
            "the picture is drawn",
            "document.querySelectorAll('#map image[transform]').length === 1",
        ),
        (
            "with whom it is by",
            "document.querySelector('#map .attribution').textContent === 'surveyors'",
        ),
        (
            "the platform's place and attitude are said",
            "/^UAV at .* m, heading \\d+°/.test(document.getElementById('platform').textContent)",
        ),
        (
            "users are verified on it",
            "document.querySelectorAll('#map .beam.verified').length >= 3",
        ),
    ];
    for (what, condition) in shown {
        until(&mut page, what, condition).await;
    }
    page.screenshot("background").await;
    assert_eq!(page.errors(), Vec::<String>::new());
}

/// Where pictures of the page go, if anybody wants them.
fn pictures() -> Option<PathBuf> {
    std::env::var_os("OAPWATCH_TEST_PICTURES").map(PathBuf::from)
}
