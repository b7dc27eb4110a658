// The scene of the tests in Qt Quick 3D Xr, in centimeters; ends when a file named
// `end` is next to this one (QML_XHR_ALLOW_FILE_READ=1).
import QtQuick
import QtQuick3D
import QtQuick3D.Xr

XrView {
    depthSubmissionEnabled: true
    referenceSpace: XrView.ReferenceSpaceStage
    environment: SceneEnvironment {
        clearColor: "#8090a0"
        backgroundMode: SceneEnvironment.Color
    }
    onInitializeFailed: (message) => { console.warn(message); Qt.exit(3) }
    onSessionEnded: Qt.quit()
    xrOrigin: XrOrigin { camera: XrCamera { clipNear: 5; clipFar: 2000 } }

    component Box: Model {
        property color color
        property real width
        property real height
        property real depth: width
        source: "#Cube" // 100 cm a side
        scale: Qt.vector3d(width / 100, height / 100, depth / 100)
        materials: PrincipledMaterial {
            lighting: PrincipledMaterial.NoLighting
            baseColor: parent.color
        }
    }

    // Stripes of 0.76 degrees 6 m away, above the horizon
    Repeater3D {
        model: 100
        Box {
            x: (index - 49.5) * 8
            y: 285
            z: -600
            width: 8
            height: 200
            depth: 1
            color: index % 2 ? "#f0f0f0" : "#202020"
        }
    }
    // Stripes of 0.8 degrees 25 cm away, below the horizon
    Repeater3D {
        model: 60
        Box {
            x: (index - 29.5) * 0.35
            y: 156
            z: -25
            width: 0.35
            height: 5
            depth: 0.1
            color: index % 2 ? "#f0f0f0" : "#202020"
        }
    }
    Box { x: -25; y: 120; z: -100; width: 20; height: 20; color: "#d02020" }
    Box { x: 25; y: 120; z: -100; width: 20; height: 20; color: "#2040d0" }

    Timer {
        interval: 500
        running: true
        repeat: true
        onTriggered: {
            const request = new XMLHttpRequest()
            request.onreadystatechange = () => {
                if (request.readyState === XMLHttpRequest.DONE && request.responseText)
                    Qt.quit()
            }
            request.open("GET", Qt.resolvedUrl("end"))
            request.send()
        }
    }
}
