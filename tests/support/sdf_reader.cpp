// Prints what libsdformat makes of a file: one line per sensor, its pose in the model, and of lidars their rays and range.
#include <iomanip>
#include <iostream>

#include <sdf/Lidar.hh>
#include <sdf/Link.hh>
#include <sdf/Model.hh>
#include <sdf/Root.hh>
#include <sdf/Sensor.hh>

int main(int, char **arguments)
{
  sdf::Root root;
  const auto faults = root.Load(arguments[1]);
  for (const auto &fault : faults)
    std::cerr << fault.Message() << "\n";
  if (!faults.empty() || root.Model() == nullptr)
    return 1;
  std::cout << std::setprecision(17);
  const auto *model = root.Model();
  for (uint64_t place = 0; place < model->LinkCount(); ++place)
  {
    const auto *link = model->LinkByIndex(place);
    for (uint64_t index = 0; index < link->SensorCount(); ++index)
    {
      const auto *sensor = link->SensorByIndex(index);
      auto pose = sensor->RawPose();
      for (const auto &fault : sensor->SemanticPose().Resolve(pose, "__model__"))
        std::cerr << fault.Message() << "\n";
      const auto *lidar = sensor->LidarSensor();
      if (lidar == nullptr && sensor->Type() != sdf::SensorType::CUSTOM)
        return 1;
      const auto &turn = pose.Rot();
      std::cout << sensor->Name() << " " << sensor->TypeStr() << " " << (lidar ? sensor->Topic() : "-") << " "
                << pose.Pos().X() << " " << pose.Pos().Y() << " " << pose.Pos().Z() << " " << turn.W() << " " << turn.X()
                << " " << turn.Y() << " " << turn.Z();
      if (lidar == nullptr)
      {
        std::cout << "\n";
        continue;
      }
      std::cout << " " << sensor->UpdateRate() << " " << lidar->HorizontalScanSamples() << " "
                << lidar->HorizontalScanMinAngle().Radian() << " " << lidar->HorizontalScanMaxAngle().Radian() << " "
                << lidar->VerticalScanSamples() << " " << lidar->VerticalScanMinAngle().Radian() << " "
                << lidar->VerticalScanMaxAngle().Radian() << " " << lidar->HorizontalScanResolution() << " "
                << lidar->VerticalScanResolution() << " " << lidar->RangeMin() << " " << lidar->RangeMax() << "\n";
    }
  }
  return 0;
}
